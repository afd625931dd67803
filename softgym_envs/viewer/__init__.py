"""Images and recordings of robots; other packages import it only when they draw."""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports

if TYPE_CHECKING:
    from softgym_envs.viewer.image import render_bodies as render_bodies

__getattr__, __dir__, __all__ = lazy_exports(__name__, {"image": ["render_bodies"]})
