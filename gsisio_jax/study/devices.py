"""Several devices of one machine: the cases of a tile are spread over them, everything else is copied to each."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

AXIS = "case"


def flat(call: str, mesh: Any) -> Mesh:
    """The devices of a mesh in one row; names and types of its axes do not matter here.

    Raises:
        ValueError: it is no mesh, or a device belongs to another process.
    """
    if not isinstance(mesh, Mesh):
        raise ValueError(
            f"{call}: `mesh` must be a jax.sharding.Mesh of local devices, for example jax.make_mesh((2,), ('case',)); "
            f"got {type(mesh).__name__}"
        )
    devices = mesh.devices.ravel()
    far = [device for device in devices if device.process_index != jax.process_index()]
    if far:
        raise ValueError(
            f"{call}: `mesh` must hold devices of this process only, got {far[0]} of process {far[0].process_index}; "
            "for several machines give `client`, a dask.distributed.Client"
        )
    return Mesh(devices, (AXIS,))


def padded(count: int, mesh: Mesh) -> int:
    """The next multiple of the number of devices."""
    return -(-count // mesh.size) * mesh.size


def spread(tree: Any, mesh: Mesh) -> Any:
    """Arrays with a leading axis of cases (a multiple of the number of devices), one block of cases per device."""
    return jax.device_put(tree, NamedSharding(mesh, PartitionSpec(AXIS)))


def copied(tree: Any, mesh: Mesh) -> Any:
    """Arrays that every device needs."""
    return jax.device_put(jax.tree.map(np.asarray, tree), NamedSharding(mesh, PartitionSpec()))
