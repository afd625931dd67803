"""The table of compliant modules. A new module needs its own file and one row here."""

from __future__ import annotations

from softgym_envs.registry import Registry

MODULES = Registry(
    "module",
    {
        "solid_block": "softgym_envs.robots.modules.solid_block:SolidBlock",
        "printed_block": "softgym_envs.robots.modules.printed_block:PrintedBlock",
        "leaf_spring": "softgym_envs.robots.modules.leaf_spring:LeafSpring",
        "crossed_leaves": "softgym_envs.robots.modules.crossed_leaves:CrossedLeaves",
        "notch_hinge": "softgym_envs.robots.modules.notch_hinge:NotchHinge",
        "torsion_tube": "softgym_envs.robots.modules.torsion_tube:TorsionTube",
        "bellows": "softgym_envs.robots.modules.bellows:Bellows",
        "accordion": "softgym_envs.robots.modules.accordion:Accordion",
    },
    base="softgym_envs.robots.modules.base:Module",
)
"""All modules by name."""
