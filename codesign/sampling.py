"""Samplers of Optuna: their names in configurations, their options, and the seed of each trial."""

from __future__ import annotations

import inspect
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field, model_validator

from softgym_envs.config import Config
from softgym_envs.registry import Table, import_place, is_place

if TYPE_CHECKING:
    import optuna

SAMPLERS = Table(
    "sampler",
    {
        "tpe": "optuna.samplers:TPESampler",
        "cmaes": "optuna.samplers:CmaEsSampler",
        "gp": "optuna.samplers:GPSampler",
        "nsgaii": "optuna.samplers:NSGAIISampler",
        "qmc": "optuna.samplers:QMCSampler",
        "random": "optuna.samplers:RandomSampler",
    },
    group="softgym_envs.samplers",
)
"""Samplers of Optuna by name: those of Optuna itself and of installed packages, as classes."""


class SamplerConfig(Config):
    """Algorithm that proposes designs: a key of `SAMPLERS` or ``module:Class``, its seed and further arguments."""

    name: str = "tpe"
    seed: int = Field(default=0, ge=0)
    options: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _known_options(self) -> SamplerConfig:
        check_options("sampler", self.name, find_class("sampler", self.name, SAMPLERS), self.options)
        return self


def trial_seed(config: SamplerConfig, number: int) -> int:
    """Return the seed of the sampler for one trial.

    It follows from the trial's number, so the result does not depend on which worker runs the trial or where a search
    was stopped. A quasi-random sequence has one seed for all trials and counts its points in the storage.
    """
    if config.name == "qmc":
        return config.seed
    return int(np.random.SeedSequence([config.seed, number]).generate_state(1)[0])


def make_sampler(config: SamplerConfig, number: int) -> optuna.samplers.BaseSampler:
    """Return the sampler for one trial."""
    cls = find_class("sampler", config.name, SAMPLERS)
    seed = {"seed": trial_seed(config, number)} if "seed" in inspect.signature(cls).parameters else {}
    return construct(cls, {**seed, **config.options})


def find_class(kind: str, name: str, table: Table) -> type:
    """Return a sampler or pruner: one of a table, or of yours or OptunaHub's as ``module:Class``.

    Raises:
        ValueError: for an unknown name, or a place where there is no class.
    """
    if not is_place(name):
        found: type = table.find(name)
        return found
    found = import_place(kind, name)
    if not isinstance(found, type):
        raise ValueError(f"{kind} '{name}' must be a class, got {found!r}")
    return found


def construct(cls: type, options: dict[str, Any]) -> Any:
    """Return a sampler or pruner of Optuna, without its warning that a class is experimental."""
    from optuna.exceptions import ExperimentalWarning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ExperimentalWarning)
        return cls(**options)


def check_options(kind: str, name: str, cls: type, options: dict[str, Any]) -> None:
    """Raise ValueError for a keyword that the class of a sampler or pruner does not take."""
    allowed = [key for key in inspect.signature(cls).parameters if key not in ("seed", "args", "kwargs")]
    for key in options:
        if key not in allowed:
            raise ValueError(f"unknown option '{key}' of {kind} '{name}'; allowed: {', '.join(allowed) or 'none'}")
    try:
        construct(cls, options)
    except TypeError as error:
        raise ValueError(f"{kind} '{name}': {error}") from None
