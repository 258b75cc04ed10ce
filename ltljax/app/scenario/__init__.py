"""A name or a file becomes a `Scenario`, ready to be solved.

`__init__.pyi` lists the names of this package. They are imported when they are first used, so that the command line
can list scenarios without loading JAX.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
