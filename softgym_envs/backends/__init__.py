"""Backends: one interface, several physics. A new backend needs its file and one row in `registry.BACKENDS`."""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports

if TYPE_CHECKING:
    from softgym_envs.backends.backend import Backend as Backend
    from softgym_envs.backends.backend import State as State
    from softgym_envs.backends.registry import make_backend as make_backend

__getattr__, __dir__, __all__ = lazy_exports(__name__, {"backend": ["Backend", "State"], "registry": ["make_backend"]})
