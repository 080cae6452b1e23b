"""``python docs/draw_examples.py [NAME ...]``: the pictures of docs/examples.md, small enough for a repository."""

import sys
import tempfile
from pathlib import Path

import jax
from PIL import Image

import gsisio_jax as gx

FOLDER = Path(__file__).parent / "images" / "examples"
WIDTH, COLOURS = 800, 64


def main(names: list[str]) -> None:
    jax.config.update("jax_enable_x64", True)
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name in names or [name for name in gx.examples.names() if name != "flight"]:  # which has a picture of its own
        with tempfile.TemporaryDirectory() as folder:
            gx.examples.load(name).picture(Path(folder) / "picture.png")
            with Image.open(Path(folder) / "picture.png") as picture:
                size = WIDTH, round(WIDTH * picture.height / picture.width)
                small = picture.convert("RGB").resize(size, Image.Resampling.LANCZOS)
                # The method by counts would take the few orange dots for black ones.
                small = small.quantize(COLOURS, Image.Quantize.MAXCOVERAGE)
                small.save(FOLDER / f"{name}.png", optimize=True)
        print(name, (FOLDER / f"{name}.png").stat().st_size, "bytes", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
