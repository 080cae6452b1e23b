"""What importing the package costs and leaves alone."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import gsisio_jax

PACKAGE = Path(gsisio_jax.__file__).parent
# Everything `estimate`, `start` and `step` may run through.
FOLDERS = ("inclusion", "interval", "observer", "plant")
FILES = (PACKAGE / "errors.py", PACKAGE / "tracing.py")
ONLINE = sorted([*FILES, *(path for name in FOLDERS for path in (PACKAGE / name).rglob("*.py"))])


def _fresh(code: str) -> str:
    """What a new interpreter prints."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_import_leaves_the_heavy_packages_alone():
    heavy = ("cvxpy", "clarabel", "highspy", "pandas", "xarray", "matplotlib", "pydantic", "rich", "gsisio_jax.design")
    loaded = _fresh(f"import sys, gsisio_jax; print([name for name in {heavy!r} if name in sys.modules])")
    assert loaded == "[]"


def test_import_brings_no_scipy_of_its_own():
    """JAX may import SciPy or not; the package adds nothing to it."""
    code = "import sys, jax, jax.numpy, equinox, jaxtyping; before = set(sys.modules); import gsisio_jax; "
    assert _fresh(code + "print(sorted(m for m in set(sys.modules) - before if m.startswith('scipy')))") == "[]"


def test_the_listed_names_are_the_public_ones():
    assert dir(gsisio_jax) == sorted(gsisio_jax.__all__)
    assert all(hasattr(gsisio_jax, name) for name in dir(gsisio_jax))


def test_import_changes_no_configuration():
    code = "import jax; before = dict(jax.config.values); import gsisio_jax; print(dict(jax.config.values) == before, "
    assert _fresh(code + "jax.config.jax_enable_x64)") == "True False"


@pytest.mark.parametrize("path", ONLINE, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_online_modules_never_import_the_design(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        assert not [n for n in names if n.startswith(("gsisio_jax.design", "cvxpy", "clarabel", "highspy", "scipy"))]


def test_a_run_needs_no_solver():
    """A saved design's step can be traced without the solver being imported."""
    code = (
        "import sys, jax, gsisio_jax.observer.types, gsisio_jax.observer.estimation; "
        "print(any(n.startswith('gsisio_jax.design') or n == 'cvxpy' for n in sys.modules))"
    )
    assert _fresh(code) == "False"
