"""Training of learned condensed models with torch: ``softgym fit``."""

from __future__ import annotations

import functools
import hashlib
import json
import operator
import shutil
import time
from dataclasses import asdict, astuple, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from softgym_envs.config import BesideConfig, Config
from softgym_envs.errors import ConfigError
from softgym_envs.extensions.fitting.correction import fit_correction
from softgym_envs.extensions.fitting.data.dataset import generate_dataset, lost
from softgym_envs.extensions.fitting.data.sampling import HasParts, SamplingPlan
from softgym_envs.extensions.fitting.data.states import full_compliance, stable_rows, training_states, with_images
from softgym_envs.extensions.fitting.row_errors import RowErrors
from softgym_envs.extensions.fitting.trainer import Trainer
from softgym_envs.extras import require
from softgym_envs.registry import Table
from softgym_envs.robots.base import Robot
from softgym_envs.robots.registry import make_robot
from softgym_envs.runs import RunFolder
from softgym_envs.storage import atomic_write
from softgym_envs.surrogate.domain import DISTRUST_REASONS
from softgym_envs.surrogate.features import Features
from softgym_envs.surrogate.model import SurrogateModel, definite
from softgym_envs.surrogate.weight_files import load_model, new_card, save_model
from softgym_envs.wording import counted

NETWORKS = Table("network", {"potential": "softgym_envs.extensions.fitting.potential"}, group="softgym_envs.networks")
"""Kind to module. Each module has ``Model`` (a `SurrogateModel`), ``Options`` (its hyper-parameters, a `Config` whose
``kind`` is its key) and ``train(robot, training, validation, trainer) -> (tensors, histories)``."""

SPLITS = ("train", "validation", "test")

Datasets = dict[str, dict[str, np.ndarray]]
"""By name of the dataset, the columns of its states by name; the first axis runs over states."""

BUCKLING = 0.01
"""If more than this share of the training states is unstable, the model must detect them; below, that is not worth its
cost."""


class SplitConfig(Config):
    """One dataset split, see `SamplingPlan`; without a ``boundary`` of its own, it has that of all data."""

    groups: int = Field(gt=0)
    states: int = Field(ge=0)
    sequence: Literal["halton", "sobol", "latin", "random", "vertices"] = "random"
    seed: int = Field(default=0, ge=0)
    boundary: float | None = Field(default=None, ge=0.0, le=1.0)
    share: float = Field(default=1.0, gt=0.0, le=1.0)
    loads: int = Field(default=1, gt=0)


class DataConfig(Config):
    """Three separate datasets. The validation set chooses the best step of a training; the test set is used once.

    ``more`` is a second set of training states, for example bodies at the vertices of the design box. ``within`` names
    a robot on whose paths the states of the learned one lie, which is a part of it (`SamplingPlan`).
    Seeds default to 0, 1 and 2. An interrupted run keeps finished shards of ``groups_per_shard`` bodies; choose small
    ones where a body takes long.
    """

    train: SplitConfig
    validation: SplitConfig
    test: SplitConfig
    more: SplitConfig | None = None
    margin: float = Field(default=0.1, ge=0.0, le=1.0)
    vary: tuple[str, ...] | None = None
    design: dict[str, float] = {}
    bounds: dict[str, tuple[float, float]] = {}
    alike: tuple[str, ...] = ()
    boundary: float = Field(default=0.0, ge=0.0, le=1.0)
    one_mesh: bool = False
    within: str = ""
    groups_per_shard: int = Field(default=10, gt=0)

    @model_validator(mode="before")
    @classmethod
    def _default_seeds(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        given = {name: data[name] for name in SPLITS if isinstance(data.get(name), dict)}
        return data | {name: {"seed": SPLITS.index(name), **split} for name, split in given.items()}

    @model_validator(mode="after")
    def _separate(self) -> DataConfig:
        drawn = [(getattr(self, split).sequence, getattr(self, split).seed) for split in SPLITS]
        for k, split in enumerate(SPLITS):
            if drawn[k] in drawn[:k]:
                raise ValueError(
                    f"{split} would have the same points as {SPLITS[drawn.index(drawn[k])]} (sequence "
                    f"'{drawn[k][0]}', seed {drawn[k][1]}); choose another seed"
                )
        return self

    def plan(self, split: str) -> SamplingPlan:
        """Return the plan of the dataset ``split``: "train", "validation" or "test"."""
        return self.plan_of(getattr(self, split))

    def plan_of(self, split: SplitConfig) -> SamplingPlan:
        """Return the plan of another split, with the margin and the design variables of this one."""
        shared = self.model_dump(exclude={*SPLITS, "more", "groups_per_shard"})
        return SamplingPlan(**{**shared, **split.model_dump(exclude_none=True)})


class PretrainingConfig(Config):
    """Cheap states that the network learns first, for example those of a coarse mesh.

    Attributes:
        robot_options: options that replace those of the robot.
        train: states to learn.
        validation: states that choose the best step.
        steps: optimisation steps.
    """

    robot_options: dict[str, Any]
    train: SplitConfig
    validation: SplitConfig
    steps: int = Field(gt=0)


class CorrectionConfig(Config):
    """Few states on a coarser and a finer mesh, for a factor to the converged efforts.

    Attributes:
        coarser: options of the coarser mesh, which replace those of the robot.
        own: likewise for the robot's own mesh, such as no contact, if the others have none.
        finer: options of the finer mesh.
        sizes: of the elements from coarse to fine, in any unit.
        states: the same states on the coarser mesh, that of the robot, and the finer one.
    """

    coarser: dict[str, Any]
    own: dict[str, Any] = {}
    finer: dict[str, Any]
    sizes: tuple[float, float, float]
    states: SplitConfig

    @model_validator(mode="after")
    def _decreasing(self) -> CorrectionConfig:
        coarse, middle, fine = self.sizes
        if not coarse > middle > fine > 0.0:
            raise ValueError(f"sizes = {list(self.sizes)} must decrease and be positive")
        return self


if TYPE_CHECKING:
    NetworkOptions = Any
else:
    #: Hyper-parameters of the network that ``kind`` names.
    NetworkOptions = Annotated[
        functools.reduce(operator.or_, (NETWORKS.find(kind).Options for kind in NETWORKS)),
        Field(discriminator="kind"),
    ]


class TrustConfig(Config):
    """Calibration of the uncertainty after the training (`softgym_envs.extensions.fitting.calibration`).

    Attributes:
        bodies: bodies of each stratum.
        states: commands of each body.
        adversarial_states: states of the search for the worst trusted ones; 0 for no search.
        seed: of all these states.
    """

    bodies: int = Field(default=64, gt=0)
    states: int = Field(default=5, gt=0)
    adversarial_states: int = Field(default=500, ge=0)
    seed: int = Field(default=11, ge=0)


class FitConfig(Config):
    """Configuration of a surrogate: robot, data and network.

    Attributes:
        robot: registered name, or path ``module:class``.
        robot_options: options of the robot.
        data: the states that are solved on FEM, for training, validation and test.
        pretraining: cheaper states that are learned before those of ``data``; only for potential networks.
        correction: states on other meshes, by which the efforts are corrected.
        network: kind of the network and its hyper-parameters.
        workers: number of processes that solve FEM states.
        seed: seed of the training.
        alone: whether the model will run alone. False for a robot with a ``max_effort``, whose model serves the backend
            ``hybrid`` or a chain of learned parts: they know efforts.
        trust: calibrate the uncertainty under commands, by stratum; None leaves it calibrated on the validation states.
    """

    robot: str
    robot_options: Annotated[dict[str, Any], BesideConfig()] = {}
    data: DataConfig
    pretraining: PretrainingConfig | None = None
    correction: CorrectionConfig | None = None
    network: NetworkOptions = Field(default_factory=NETWORKS.find("potential").Options)
    workers: int = Field(default=2, gt=0)
    seed: int = 0
    alone: bool = True
    trust: TrustConfig | None = None

    @model_validator(mode="after")
    def _pretrained_kind(self) -> FitConfig:
        if self.pretraining is not None and self.network.kind != "potential":
            raise ValueError(f"only networks of kind 'potential' can be pretrained, not '{self.network.kind}'")
        return self


def measure_errors(model: SurrogateModel, data: dict[str, np.ndarray]) -> dict[str, float]:
    """Return errors of a model on a dataset.

    ``effector``: distance between predicted and FEM effector at the same reached displacement [m]; ``compliance``:
    relative Frobenius error of W; ``effort``: relative to the largest effort in the data; ``sensor``: relative to
    `Sensing.scale`, if there are sensors.
    """
    stable = stable_rows(model.robot, data)
    data = {name: column[stable] for name, column in data.items()}
    context = model.context(data["design"])
    effort, effector, _ = model.state(context, data["displacement"])
    W = model.compliance(context, data["displacement"])
    n = model.size
    truth = full_compliance(data["compliance"], n)
    coordinates, sensors = np.split(data["effector"], [model.effectors], axis=1)
    distance = np.linalg.norm((effector - coordinates).reshape(len(effort), -1, 3), axis=2).max(axis=1)
    shown: dict[str, float] = {}
    if model.sensors:
        wrong = (
            np.abs(model.sensed(context, data["displacement"]) - sensors).max(axis=1) / model.robot.sensing.scale.max()
        )
        shown = {
            "sensor_mean": float(wrong.mean()),
            "sensor_p99": float(np.quantile(wrong, 0.99)),
            "sensor_worst": float(wrong.max()),
        }
        # Rows in m and in m3 compare only in the scales of the network.
        W, truth = (matrix / model.features.units[:, None] / model.features.units for matrix in (W, truth))
    relative = np.linalg.norm(W - truth, axis=(1, 2)) / np.linalg.norm(truth, axis=(1, 2))
    effort_error = np.abs(effort - data["effort"]).max(axis=1) / np.abs(data["effort"]).max()
    return {
        "states": len(effort),
        "effector_mean": float(distance.mean()),
        "effector_p99": float(np.quantile(distance, 0.99)),
        "effector_worst": float(distance.max()),
        "compliance_median": float(np.median(relative)),
        "compliance_p99": float(np.quantile(relative, 0.99)),
        "compliance_worst": float(relative.max()),
        "effort_mean": float(effort_error.mean()),
        "effort_worst": float(effort_error.max()),
        **shown,
        # Rows have units that differ by many orders of magnitude, so the smallest eigenvalues would be round-off.
        "positive_definite": float(definite(0.5 * (W + np.swapaxes(W, 1, 2))).mean()),
        "asymmetry_worst": float(np.abs(W - np.swapaxes(W, 1, 2)).max() / np.abs(W).max()),
    }


def trusted_part(model: SurrogateModel, data: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return how much of a dataset a model is trusted on, and its errors there and elsewhere.

    Returns:
        ``share`` of the stable states that are trusted; ``effector_p95``, below which 95 % of the errors of these lie,
        and ``elsewhere_p95``, of the others [m] (None without any); ``reasons``: share of the states for each reason of
        distrust; ``effort``: largest effort of each actuator in the data.
    """
    data = {name: column[stable_rows(model.robot, data)] for name, column in data.items()}
    context = model.context(data["design"])
    _, effector, spread = model.state(context, data["displacement"])
    truth = data["effector"][:, : model.effectors]
    error = np.linalg.norm((effector - truth).reshape(len(spread), -1, 3), axis=2).max(axis=1)
    code = model.distrust(context, data["displacement"], spread)[1]
    parts = {"effector_p95": error[code == 0], "elsewhere_p95": error[code != 0]}
    return {
        "share": float((code == 0).mean()),
        **{name: float(np.quantile(values, 0.95)) if len(values) else None for name, values in parts.items()},
        "reasons": {text: float(((code & n) > 0).mean()) for n, text in DISTRUST_REASONS.items() if (code & n).any()},
        "effort": np.abs(data["effort"]).max(axis=0).tolist(),
    }


def row_errors(model: SurrogateModel, data: dict[str, np.ndarray]) -> RowErrors:
    """Return the errors of effectors [m] and sensors under the displacements of a dataset."""
    data = {name: column[stable_rows(model.robot, data)] for name, column in data.items()}
    context, robot = model.context(data["design"]), model.robot
    rows = [model.effector(context, data["displacement"])[0]]
    if model.sensors:
        rows.append(model.sensed(context, data["displacement"]))
    shares = (data["displacement"] - robot.lower) / (robot.upper - robot.lower)
    return RowErrors.fit(shares.mean(axis=1), np.concatenate(rows, axis=1) - data["effector"])


def domain_of(
    model: SurrogateModel, training: dict[str, np.ndarray], validation: dict[str, np.ndarray]
) -> dict[str, Any]:
    """Return where a model may be trusted: the box of all states that it learned, and its uncertainty on others.

    Returns:
        ``displacement`` and ``design`` ranges; ``inflation``: factor that turns the spread of the ensemble into a bound
        on 95 % of the validation errors; ``limit``: uncertainty that 98 % of the validation states stay below, at most
        the goal tolerance [m]; and, if more than `BUCKLING` of the training states were left out, ``growth``: how many
        times softer than at zero displacement the actuators are, a bound on 98 % of the validation states.
    """
    stable = stable_rows(model.robot, training)
    training = {name: column[stable] for name, column in training.items()}
    names = model.robot.design_space.names
    domain: dict[str, Any] = {
        "displacement": [[float(c.min()), float(c.max())] for c in training["displacement"].T],
        "design": {
            n: [float(c.min()), float(c.max())]
            for n, c in zip(names, training["design"].T, strict=True)
            if n != model.robot.learning.stiffness_variable
        },
    }
    data = {name: column[stable_rows(model.robot, validation)] for name, column in validation.items()}
    context = model.context(data["design"])
    _, effector, spread = model.state(context, data["displacement"])
    if np.isfinite(spread).all():
        truth = data["effector"][:, : model.effectors]
        distance = np.linalg.norm((effector - truth).reshape(len(spread), -1, 3), axis=2).max(axis=1)
        domain["inflation"] = float(np.quantile(distance / np.maximum(spread, 1e-12), 0.95))
        limit = domain["inflation"] * float(np.quantile(spread, 0.98))
        domain["limit"] = min(limit, model.robot.goal_tolerance)
    if model.robot.learning.convex and 1.0 - stable.mean() > BUCKLING:
        domain["growth"] = float(np.quantile(model.softening_ratio(context, data["displacement"]), 0.98))
    return domain


def check_learnable(robot: Robot, config: FitConfig) -> None:
    """Refuse, before any state is solved, a robot whose learned model no backend would take.

    Raises:
        ConfigError: for obstacles, for drives that stretch, and for actuators with a largest effort if the model is to
            run alone.
    """
    if robot.obstacles or type(robot).own_obstacles is not Robot.own_obstacles:
        raise ConfigError(
            f"robot '{robot.name}' touches obstacles, which a surrogate does not learn: use backend='fem', or fit it "
            "without them"
        )
    if config.alone and (limited := robot.effort_limited):
        raise ConfigError(
            f"robot '{robot.name}': a surrogate would drive {', '.join(limited)} beyond max_effort: leave it out and "
            "check efforts afterwards, or set alone = false for backend='hybrid'"
        )
    if stretching := [drive.name for drive in robot.build().constraints["a"] if drive.compliance]:
        raise ConfigError(
            f"robot '{robot.name}': the drives of {', '.join(stretching)} stretch, which a surrogate does not learn: "
            "use backend='fem', or leave compliance out"
        )


def check_within(whole: Robot, robot: Robot) -> None:
    """Refuse paths of a robot of which the learned one is no part.

    Raises:
        ConfigError: if it is not.
    """
    if not isinstance(whole, HasParts):
        raise ConfigError(f"data.within = '{whole.name}': it has no parts to learn")
    if (part := whole.one_part().name) != robot.name:
        raise ConfigError(f"data.within = '{whole.name}': its part is '{part}', not '{robot.name}'")


def generate_datasets(config: FitConfig, data_folder: str | Path, *, progress: bool = True) -> Datasets:
    """Return the datasets of a surrogate; whatever is missing is generated.

    Returns:
        ``train``, ``validation`` and ``test``; with more training states also ``more/train``; with pretraining also
        ``pretraining/train`` and ``pretraining/validation``; with a correction also ``correction/coarser``,
        ``correction/own`` and ``correction/finer``.
    """
    robot = make_robot(config.robot, **config.robot_options)
    check_learnable(robot, config)
    if config.data.within:
        check_within(make_robot(config.data.within, **config.robot_options), robot)
    run = RunFolder(data_folder, FitConfig, "datasets")
    if not run.begun:  # an existing file is kept until the data are accepted
        run.begin(config)
    options, data = config.robot_options, config.data
    plans = {split: (options, data.plan(split)) for split in SPLITS}
    if data.more is not None:
        plans["more/train"] = options, data.plan_of(data.more)
    if coarse := config.pretraining:
        for split in ("train", "validation"):
            plans[f"pretraining/{split}"] = options | coarse.robot_options, data.plan_of(getattr(coarse, split))
    if fine := config.correction:
        plan = replace(data.plan_of(fine.states), margin=0.0)  # efforts are compared at equal commands
        for level, changed in (("coarser", fine.coarser), ("own", fine.own), ("finer", fine.finer)):
            plans[f"correction/{level}"] = options | changed, plan
    found = {
        name: generate_dataset(
            Path(data_folder) / name,
            config.robot,
            plan,
            robot_options=robot_options,
            groups_per_shard=data.groups_per_shard,
            workers=config.workers,
            progress=progress,
        )
        for name, (robot_options, plan) in plans.items()
    }
    run.begin(config)
    return found


def fit(config: FitConfig, folder: str | Path, data_folder: str | Path, *, progress: bool = True) -> dict[str, float]:
    """Generate missing data, train, test once, and write the weights with their card.

    Args:
        config: robot, data and network.
        folder: folder for ``model.safetensors``, ``model.json`` and ``history.npz``. Weights of the same configuration
            and data are not trained again.
        data_folder: folder of the datasets, see `generate_datasets`.
        progress: show progress bars.

    Returns:
        The errors on the test set.
    """
    require("train")
    import torch

    folder, data_folder = Path(folder), Path(data_folder)
    robot = make_robot(config.robot, **config.robot_options)
    data = generate_datasets(config, data_folder, progress=progress)
    inputs = _inputs(config, data)
    known = _known_errors(folder, robot, inputs)
    if known is not None:
        return known
    torch.set_num_threads(1)
    features = Features(robot)
    learned = _learned(robot, data)
    states = {name: training_states(robot, columns, features) for name, columns in learned.items()}
    trained = _train(config, robot, states, folder / "parts", inputs, progress)
    Model = NETWORKS.find(config.network.kind).Model
    model = Model(robot, trained.tensors, {})
    errors = measure_errors(model, data["test"])
    # Cheap states are learned, too, and few expensive ones hardly reach the bounds of the boxes.
    parts = [learned[name] for name in ("train", "pretraining/train") if name in learned]
    every = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    card = {
        **new_card(robot, config.network.kind),
        "config": config.model_dump(mode="json"),
        "domain": domain_of(model, every, data["validation"]),
        "loaded": bool(robot.build().loads.any() or robot.learning.loads),
        "states": {split: len(rows) for split, rows in states.items()},
        "unstable_states_left_out": {split: len(learned[split]["rest"]) - len(rows) for split, rows in states.items()},
        "data_sha256": inputs["data_sha256"],
        "training_seconds": round(trained.seconds, 1),
        "best_validation": {part: min(row["validation"] for row in rows) for part, rows in trained.histories.items()},
        "test": errors,
        **({"errors": row_errors(model, data["validation"]).to_card()} if model.sensors else {}),
        "correction": _correction(config, data, features),
    }
    card["lost"] = {name: astuple(lost(data_folder / name)) for name in data}
    card["trusted"] = trusted_part(Model(robot, trained.tensors, card), data["test"])
    save_model(Model(robot, trained.tensors, card), folder)
    history = {f"{p}_{k}": np.array([row[k] for row in rows]) for p, rows in trained.histories.items() for k in rows[0]}
    with atomic_write(folder / "history.npz") as stream:
        np.savez_compressed(stream, allow_pickle=False, **history)
    RunFolder(folder, FitConfig, "a fit").begin(config)
    load_model(folder, robot)  # fail now if the written files cannot be read
    if config.trust is not None:
        from softgym_envs.extensions.fitting.calibration import calibrate
        from softgym_envs.extensions.fitting.within import calibrate_within

        options = config.trust.model_dump() | {"state_folder": data_folder / "judged", "workers": config.workers}
        if config.data.within:
            del options["adversarial_states"]
            calibrate_within(folder, make_robot(config.data.within, **config.robot_options), **options)
        else:
            calibrate(folder, robot, **options)
    shutil.rmtree(folder / "parts", ignore_errors=True)
    return errors


def _inputs(config: FitConfig, data: Datasets) -> dict[str, Any]:
    """Return what the weights follow from: the configuration and a hash of the data."""
    digest = hashlib.sha256()
    for split in data.values():
        for column in split.values():
            digest.update(np.ascontiguousarray(column).tobytes())
    return {
        "config": config.model_dump(mode="json", exclude={"workers"}),
        "data_sha256": digest.hexdigest(),
    }


def _known_errors(folder: Path, robot: Robot, inputs: dict[str, Any]) -> dict[str, float] | None:
    """Return the errors on the test set of weights in a folder; None if there are none of the same inputs."""
    if not (folder / "model.json").exists():
        return None
    card = load_model(folder, robot).card
    same = all(card["config"].get(name) == value for name, value in inputs["config"].items())
    return card["test"] if same and card["data_sha256"] == inputs["data_sha256"] else None


def _learned(robot: Robot, data: Datasets) -> Datasets:
    """Return the datasets with what a training adds: mirror images, and further training states beside the others."""
    learned = {
        name: with_images(robot, columns) if name.endswith("train") else columns for name, columns in data.items()
    }
    if more := learned.pop("more/train", None):
        learned["train"] = {name: np.concatenate([column, more[name]]) for name, column in learned["train"].items()}
    return learned


@dataclass(frozen=True)
class _Trained:
    """Result of a training.

    Attributes:
        tensors: weights of all networks.
        histories: for each network the rows of its training.
        seconds: wall time.
    """

    tensors: dict[str, np.ndarray]
    histories: dict[str, list[dict[str, float]]]
    seconds: float


def _train(
    config: FitConfig, robot: Robot, states: dict[str, Any], parts: Path, inputs: dict[str, Any], progress: bool
) -> _Trained:
    """Train the networks on states; finished ones are kept in the folder ``parts``, in case of an interruption."""
    key = hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()[:12]
    trainer = Trainer(config.network, config.seed, parts, key, progress, config.workers)
    start = time.perf_counter()
    module = NETWORKS.find(config.network.kind)
    first: dict[str, Any] = {}
    if config.pretraining is not None:
        options = config.network.model_copy(update={"steps": config.pretraining.steps})
        before = Trainer(options, config.seed, parts / "pretraining", key, progress, config.workers)
        first["start"], _ = module.train(robot, states["pretraining/train"], states["pretraining/validation"], before)
    tensors, histories = module.train(robot, states["train"], states["validation"], trainer, **first)
    return _Trained(tensors, histories, time.perf_counter() - start)


def _correction(config: FitConfig, data: Datasets, features: Features) -> dict[str, Any] | None:
    """Return the factor to the converged efforts, as in the card; None without states on other meshes."""
    if config.correction is None:
        return None
    levels = [data[f"correction/{level}"] for level in ("coarser", "own", "finer")]
    return asdict(fit_correction(levels, config.correction.sizes, features.design(levels[1]["design"])))


def describe_datasets(config: FitConfig, folder: Path, *, progress: bool = True) -> list[str]:
    """Generate what is missing of the datasets of a surrogate, and return how many states there are, in lines."""
    found = generate_datasets(config, folder, progress=progress)
    return [
        f"{name}: {counted(len(columns['rest']), 'state')} of {counted(int(columns['rest'].sum()), 'design')}"
        for name, columns in found.items()
    ]
