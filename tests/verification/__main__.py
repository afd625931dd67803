"""``python -m tests.verification [NAME ...]``: compute checks at full length and print one JSON object.

The tests run shorter versions of the same functions.
"""

from __future__ import annotations

import json

import click

from tests.verification import contact, contact_control, contact_friction, dynamics, side_by_side, statics
from tests.verification.robot_dynamics import tetrapod
from tests.verification.walkers import walkers

CHECKS = {
    "statics": statics.validation,
    "contact": contact.contact,
    "dynamics": dynamics.dynamics,
    "tetrapod": tetrapod,
    "side_by_side": side_by_side.side_by_side,
    "contact_control": contact_control.contact_control,
    "contact_friction": contact_friction.contact_friction,
    "walkers": walkers,
}


@click.command(help=__doc__)
@click.argument("names", nargs=-1, type=click.Choice(list(CHECKS)))
def main(names: tuple[str, ...]) -> None:
    """Print the results of the named checks, or of all."""
    click.echo(json.dumps({name: CHECKS[name]() for name in names or CHECKS}, indent=2))


if __name__ == "__main__":
    main()
