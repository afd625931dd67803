"""The table of compliant modules. A new module needs its own file and one row here."""

from __future__ import annotations

from softgym_envs.registry import Registry

MODULES = Registry(
    "module",
    {
        "solid_block": "softgym_envs.extensions.modules.solid_block:SolidBlock",
        "leaf_spring": "softgym_envs.extensions.modules.leaf_spring:LeafSpring",
        "crossed_leaves": "softgym_envs.extensions.modules.crossed_leaves:CrossedLeaves",
        "notch_hinge": "softgym_envs.extensions.modules.notch_hinge:NotchHinge",
        "torsion_tube": "softgym_envs.extensions.modules.torsion_tube:TorsionTube",
        "bellows": "softgym_envs.extensions.modules.bellows:Bellows",
        "accordion": "softgym_envs.extensions.modules.accordion:Accordion",
    },
    base="softgym_envs.extensions.modules.base:Module",
)
"""All modules by name."""
