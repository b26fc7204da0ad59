"""Results in the formats of other programs: `KINDS` lists them, `find_kind(name).write(...)` writes one."""

import lazy_loader

# The names are those of __init__.pyi. A module is imported when one of its names is asked for: many processes need only
# options and states, and all modules take a second.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
