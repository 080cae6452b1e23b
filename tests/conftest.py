"""The reference results are double precision; float32 is tested by float32 inputs."""

import jax

jax.config.update("jax_enable_x64", True)
