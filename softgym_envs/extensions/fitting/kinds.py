"""What a configuration of ``softgym dataset`` and ``softgym fit`` fits: a whole robot, or what an extension adds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from softgym_envs.config import Config, config_text, read_value
from softgym_envs.registry import Table


@dataclass(frozen=True)
class FitKind:
    """A kind of fit.

    Attributes:
        config: class of its configuration.
        data: generates the missing states of a configuration in a folder, and says what there is, in lines.
        fit: fits weights for a configuration in a folder, with the data of another folder, and returns their errors.
            Both also take ``progress``.
        account: what a fit says besides its errors: lines for a configuration and the folder of the weights.
    """

    config: type[Config]
    data: Callable[..., list[str]]
    fit: Callable[..., dict[str, float]]
    account: Callable[[Any, Path], list[str]] = lambda config, folder: []


KINDS = Table(
    "kind of fit",
    {
        "part": "softgym_envs.extensions.fitting.parts.training:KIND",
        "robot": "softgym_envs.extensions.fitting.account:KIND",
    },
    group="softgym_envs.fits",
)
"""A key that only configurations of this kind have, to a `FitKind`."""


def kind_of(config: Path) -> FitKind:
    """Return the kind of fit that a configuration describes; a whole robot if it names none."""
    data = read_value(config_text(config))
    return KINDS[next((key for key in KINDS if isinstance(data, dict) and key in data), "robot")]
