"""Compliant modules with two ports, and arms that are built from them (thesis, sec. 5.2.2).

A module is known to the rest of a structure by its energy over the relative motion of its ports alone. So a structure
of any number of modules is solved with six unknowns for each port.
"""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports

if TYPE_CHECKING:
    from softgym_envs.extensions.modules.base import Module as Module
    from softgym_envs.extensions.modules.learned import learned_module as learned_module
    from softgym_envs.extensions.modules.registry import MODULES as MODULES

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "base": ["Module"],
        "learned": ["learned_module"],
        "registry": ["MODULES"],
    },
)
