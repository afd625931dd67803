"""Samplers of Optuna: their names in configurations, their options, and the seed of each trial."""

from __future__ import annotations

import inspect
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field, model_validator

from softgym_envs.config import Config
from softgym_envs.registry import Table

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
    """Algorithm that proposes designs: a key of `SAMPLERS`, its seed (`trial_seed`) and further arguments."""

    name: str = "tpe"
    seed: int = Field(default=0, ge=0)
    options: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _known_options(self) -> SamplerConfig:
        check_options("sampler", self.name, SAMPLERS.find(self.name), self.options)
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
    return construct(SAMPLERS[config.name], {"seed": trial_seed(config, number), **config.options})


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
