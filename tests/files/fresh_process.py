"""What another process makes of the files of a folder: arguments are the folder and whether JAX knows float64 there."""

import sys

import jax
import numpy as np


def main(folder: str, x64: bool) -> None:
    jax.config.update("jax_enable_x64", x64)

    from files import plants

    import gsisio_jax as gx

    observer = gx.load_observer(f"{folder}/window.observer", plants.system("window"))
    dtype = np.float64 if x64 else np.float32
    boxes = gx.estimate(observer, plants.start(dtype), plants.measurements(dtype=dtype))
    found = {f"box_{index}": np.asarray(leaf) for index, leaf in enumerate(jax.tree.leaves(boxes))}
    try:
        carry, step = gx.load_carry(f"{folder}/window.carry", observer)
        _, rest = gx.estimation.resume(observer, carry, plants.measurements()[step:])
        found |= {f"rest_{index}": np.asarray(leaf) for index, leaf in enumerate(jax.tree.leaves(rest))}
    except ValueError as error:
        found["refused"] = np.array(str(error))
    np.savez(f"{folder}/found_{x64}.npz", **found)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2] == "True")
