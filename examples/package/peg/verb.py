"""A verb: ``softgym peg``."""

import click


@click.command()
def peg():
    """Say how heavy the peg is."""
    from softgym_envs import make_robot

    click.echo(f"{1e3 * make_robot('peg').build().mass:.1f} g")
