"""A metric of bodies."""

from softgym_envs.codesign.metrics.metric import metric


@metric(unit="1", direction="minimize", source="design")
def slenderness(design):
    """Return the height of the block in widths."""
    return design["length"] / design["width"]
