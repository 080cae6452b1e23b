"""The command ``gsisio examples``: what there is, and its files to start from."""

from __future__ import annotations

import textwrap
import tomllib
from pathlib import Path

from .. import examples
from .._whole import put
from .errors import UserError, reason


def list_examples() -> int:
    """One line a built-in example: its name and what it teaches."""
    wide = max(map(len, examples.names())) + 2
    for name, teaches in examples.teaches().items():
        print(textwrap.fill(teaches, 100, initial_indent=name.ljust(wide), subsequent_indent=" " * wide))
    print("\ngsisio estimate NAME runs one; gsisio examples NAME --out DIR writes its files to start from")
    return 0


def write_example(name: str, out: Path) -> int:
    """Write the configuration and the table of an example, which overwrite nothing."""
    if name not in examples.names():
        raise UserError(f"examples: no example is called {name}; there are: {', '.join(examples.names())}")
    config = examples.config_path(name)
    table = Path(tomllib.loads(config.read_text("utf-8"))["table"]["file"])
    targets = {out / config.name: config, out / table: config.parent / table}
    for target in targets:
        if target.exists():
            raise UserError(f"examples: {target} is there already, and nothing is written over; give another --out")
    written: list[Path] = []
    try:
        for target, source in targets.items():
            target.parent.mkdir(parents=True, exist_ok=True)
            put(target, source.read_bytes())
            written.append(target)
    except OSError as error:
        for target in written:
            target.unlink()
        raise UserError(f"examples: cannot write to {out}: {reason(error)}") from error
    print(f"wrote {' and '.join(map(str, targets))}\nrun it with: gsisio estimate {out / config.name}")
    return 0
