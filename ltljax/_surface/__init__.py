"""The surface: the pytree, and how a mesh becomes one."""
