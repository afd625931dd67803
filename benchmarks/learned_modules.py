"""Errors of the learned energies of modules."""

from __future__ import annotations

from benchmarks.tables import markdown
from softgym_envs.robots.modules.learned import learned_module
from softgym_envs.robots.modules.learning import RECIPES


def learned_modules_table() -> str:
    """Errors of the learned energies on bodies that were not learned, as their files state them."""
    rows = []
    for name in RECIPES:
        for place in ("inside", "corners"):
            found = learned_module(name).errors[place]
            cells = [
                f"{100.0 * found[f'{kind}_mean']:.1f} %, {100.0 * found[f'{kind}_max']:.1f} %"
                for kind in ("strain", "stiffness")
            ]
            rows.append([f"`{name}`", place, *cells])
    return markdown(["module", "bodies", "strains: mean, largest", "stiffness: mean, largest"], rows, "llrr")


TABLES = {"learned_modules": learned_modules_table}
"""Tables of pages by name."""
