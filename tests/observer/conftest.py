"""One design for all tests of the target: its compilations are shared as well."""

import pytest
import target as target_module


@pytest.fixture(scope="session")
def target() -> target_module.Target:
    return target_module.design()
