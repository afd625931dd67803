"""Online learning: a trained ensemble learns equilibria that finite elements found where it could not be trusted.

Every member is trained a little more, on the new states and on *rehearsal* states: predictions of the member itself
where the ensemble is trusted. The member therefore does not forget, and its original data are not needed. Members
rehearse their own predictions, not those of the ensemble, and no member sees all new states, so that members still
differ where there are no data.

Four rules decide which predictions are trusted afterwards; each errs on the safe side:

* The box of known displacements and designs grows to include the new states. A box has corners without states, so this
  alone does not make a prediction trusted.
* If a robot can buckle, its actuators may become as soft as in the softest new state, but not as soft as in a state
  that was left out because it is about to buckle.
* Inside the box the spread of the ensemble decides, with the limit of the original weights: new states never make the
  model less demanding.
* Some new states are withheld from all members. If the errors there exceed what the spread predicts, the factor from
  spread to uncertainty is raised until 95 % of these errors lie below the uncertainty; it is never lowered. This
  detects members that agree on something wrong. Errors below a quarter of the limit are ignored: only a few states are
  withheld, and one with a tiny spread would otherwise raise the factor everywhere.

Withheld states come from the same episodes as the learned ones. They check predictions between those states, not far
away from them; there the disagreement of the members decides.
"""

from __future__ import annotations

import hashlib
import json
import time
import uuid
from collections.abc import Iterable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.errors import DataError, WeightsError
from softgym_envs.extensions.fitting.data.dataset import COLUMNS
from softgym_envs.extensions.fitting.data.states import GROWTH, States, stable_rows, training_states
from softgym_envs.extensions.fitting.potential import make_targets, potential_loss, stack_members, unstack_members
from softgym_envs.extras import require
from softgym_envs.robots.base import Robot
from softgym_envs.storage import atomic_write, read_json, read_npz, write_json
from softgym_envs.surrogate.model import SurrogateModel
from softgym_envs.surrogate.potential.model import Model

#: One in this many new states is withheld from all members and used to check them.
WITHHELD_EVERY = 8

#: Entries of a card about the training of the original weights, which no longer apply.
_OF_TRAINING = ("test", "best_validation", "training_seconds", "provenance")

_FORMAT = 1


def check_ensemble(model: SurrogateModel) -> Model:
    """Return the model if it is an ensemble that can decide where it may be trusted.

    Raises:
        WeightsError: for another kind of network, a single member, a robot with sensor rows, or a card without a limit.
    """
    if not isinstance(model, Model):
        raise WeightsError(f"online learning needs a network of kind 'potential'; these weights are '{model.network}'")
    if not model.robot.learning.convex:
        raise WeightsError(f"online learning needs a convex energy; that of robot '{model.robot.name}' is not")
    if model.sensors:
        raise WeightsError(
            f"online learning does not know sensor rows, which robot '{model.robot.name}' has: use backend='surrogate' "
            "or backend='fem'"
        )
    if model.members < model.trained:
        raise WeightsError(
            "online learning needs all members of an ensemble of 2 or more, because their spread decides what is "
            f"trusted; got {model.members}"
        )
    if not {"displacement", "design", "limit", "inflation"} <= model.card.get("domain", {}).keys():
        raise WeightsError("the card of the weights does not say where they are trusted; train them with 'softgym fit'")
    return model


# -- stored states -----------------------------------------------------------------------------------------------


class StateStore:
    """Equilibria collected over episodes, in memory and, if a folder is given, in npz shards written atomically.

    Shards have the columns of a dataset. Each begins with the state at rest of its body and can be read on its own.
    Several processes may collect into one folder; each reads at its start what the others have written.

    Args:
        robot: the robot of all states.
        folder: folder of the shards; existing ones are read. None keeps states in memory only.

    Attributes:
        data: all states, as columns of `COLUMNS` of the extension `fitting`, in the order of the shards.
        count: number of states, without those at rest.

    Raises:
        DataError: if the folder holds states of another robot or its manifest cannot be read. A damaged shard is
            renamed to ``*.corrupt``, with a message.
    """

    def __init__(self, robot: Robot, folder: str | Path | None = None) -> None:
        self.robot = robot
        self.folder = None if folder is None else Path(folder)
        n = len(robot.actuators) + 3 * len(robot.effectors)
        sizes = (len(robot.design_space.names), len(robot.actuators), len(robot.actuators), 3 * len(robot.effectors))
        self._widths = dict(zip(COLUMNS, (*sizes, n * (n + 1) // 2), strict=False))
        self._parts: list[dict[str, np.ndarray]] = []
        if self.folder is None:
            return
        manifest = {"format": _FORMAT, "robot": robot.name, "mechanics_key": robot.mechanics_key}
        path = self.folder / "manifest.json"
        if path.exists():
            found = read_json(path)
            if found != manifest:
                raise DataError(f"'{self.folder}' holds states of another robot: {found}, needed {manifest}")
        else:
            write_json(path, manifest)
        for shard in sorted(self.folder.glob("states_*.npz")):
            try:
                self._parts.append(self._checked(read_npz(shard, COLUMNS), f"shard '{shard}'"))
            except DataError as error:
                aside = shard.with_suffix(".corrupt")
                shard.rename(aside)
                print(f"{error}; renamed to '{aside.name}'")

    def _checked(self, part: Mapping[str, np.ndarray], what: str) -> dict[str, np.ndarray]:
        rows = len(part["rest"])
        for name, width in self._widths.items():
            if part[name].shape != (rows, width) or not np.isfinite(part[name]).all():
                raise DataError(f"{what}: '{name}' must be {rows} rows of {width} finite numbers")
        if rows == 0 or not part["rest"][0]:
            raise DataError(f"{what} does not begin with a rest state")
        return {name: np.array(part[name]) for name in COLUMNS}

    @property
    def data(self) -> dict[str, np.ndarray]:
        return {name: np.concatenate([part[name] for part in self._parts]) for name in COLUMNS}

    @property
    def count(self) -> int:
        return sum(len(part["rest"]) - int(part["rest"].sum()) for part in self._parts)

    def add(self, part: Mapping[str, np.ndarray]) -> None:
        """Add states of one body, the first of them at rest, and write their shard.

        Raises:
            DataError: if a column has a wrong shape or values that are not finite, or the state at rest is missing.
        """
        checked = self._checked(part, "new states")
        if self.folder is not None:
            # Names are unique and sort by time: several stores and processes may collect into one folder.
            with atomic_write(self.folder / f"states_{time.time_ns():020d}_{uuid.uuid4().hex}.npz") as stream:
                np.savez(stream, allow_pickle=False, **checked)
        self._parts.append(checked)


# -- learning ------------------------------------------------------------------------------------------------------


def rehearsal_states(model: Model, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return random bodies and displacements where a model is trusted: in its domain, where its ensemble agrees.

    Returns:
        Designs (count, len(space)) in the order of the space, with the stiffness variable at its baseline; and
        displacements (count, n_a). If too few of the candidates are trusted, those with the smallest spread are added.
    """
    rng = np.random.default_rng([seed, 0])
    space, domain = model.robot.design_space, model.card["domain"]
    candidates = 8 * count
    designs = np.tile([space.baseline[name] for name in space.names], (candidates, 1))
    for name, (low, high) in domain["design"].items():
        designs[:, space.names.index(name)] = rng.uniform(low, high, candidates)
    box = np.array(domain["displacement"])
    displacement = rng.uniform(box[:, 0], box[:, 1], (candidates, model.count))
    context = model.context(designs)
    spread = model.state(context, displacement)[2]
    _, trusted = model.trust(context, displacement, spread)
    # Trusted ones first, in the order in which they were drawn.
    chosen = np.argsort(np.where(trusted, 0.0, spread), kind="stable")[:count]
    return designs[chosen], displacement[chosen]


def _predicted(model: Model, designs: np.ndarray, displacement: np.ndarray) -> States:
    """Return predictions of a model as states to train on."""
    context = model.context(designs)
    effort, effector, _ = model.state(context, displacement)
    return States(
        design=model.features.design(designs),
        actuation=model.features.actuation(displacement),
        displacement=displacement,
        effort=effort,
        effector=effector,
        W=model.compliance(context, displacement),
        rest_of=np.arange(len(effort)),
    )


def _joined(a: States, b: States) -> States:
    """Concatenate two sets of states."""
    parts = {f.name: np.concatenate([getattr(a, f.name), getattr(b, f.name)]) for f in fields(States)}
    parts["rest_of"] = np.arange(len(a) + len(b))
    return States(**parts)


def fine_tune(
    model: Model,
    data: Mapping[str, np.ndarray],
    *,
    steps: int = 800,
    learning_rate: float = 3e-3,
    batch_size: int = 128,
    rehearsal: int = 1024,
    seed: int = 0,
) -> Model:
    """Return a model that has also learned new states; the given one is not changed.

    Half of every batch consists of new states, the other half of rehearsal states. The result depends only on the
    arguments.

    Args:
        model: an ensemble of potential networks whose card holds its domain.
        data: columns of equilibria, as `load_dataset` returns them; unstable ones are left out.
        steps: steps of Adam for each member.
        learning_rate: largest rate of the one-cycle schedule.
        batch_size: rows of a batch.
        rehearsal: number of rehearsal states of each member.
        seed: seed of the rehearsal states and the batches.

    Raises:
        DataError: if no new state is stable, or the training diverges.
        WeightsError: if the model is not an ensemble with a known domain.
    """
    require("train")
    import torch

    from softgym_envs.extensions.fitting.torch_potential import PotentialNet

    check_ensemble(model)
    start = time.perf_counter()
    robot, M = model.robot, model.members
    new = training_states(robot, data, model.features)
    if len(new) == 0:
        raise DataError("none of the new states is stable: there is nothing to learn")
    states, scales = unstack_members(model.tensors)
    # States are in the order of episodes; a permutation distributes neighbours over the members.
    turn = np.random.default_rng([seed, 1]).permutation(len(new))
    withheld = turn < (len(new) // WITHHELD_EVERY if len(new) >= 2 * WITHHELD_EVERY else 0)
    designs, displacement = rehearsal_states(model, rehearsal, seed)
    tuned = []
    for member in range(M):
        # Its predictions are rehearsed as it learned them: without the correction of efforts.
        own = Model(robot, _member(model.tensors, member), {**model.card, "correction": None})
        seen = np.flatnonzero(~withheld & ((turn % M != member) | (len(new) < 2 * M)))
        old = _predicted(own, designs, displacement)
        targets = make_targets(robot, _joined(new.rows(seen), old), scales)
        effort_spread = targets.effort_spread
        net = PotentialNet(
            model.count,
            model.effectors,
            new.design.shape[1],
            model.width,
            states[member]["body.0.weight"].shape[0],
            states[member].get("rest"),
        )
        net.load_state_dict({k: torch.tensor(v) for k, v in states[member].items()})
        generator = torch.Generator().manual_seed(seed + 1000 * member)
        optimiser = torch.optim.Adam(net.parameters(), lr=learning_rate, betas=(0.9, 0.99))
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimiser, learning_rate, total_steps=steps, pct_start=0.1, final_div_factor=1e3
        )
        half = batch_size // 2
        for _ in range(steps):
            rows = torch.cat(
                [
                    torch.randint(len(seen), (half,), generator=generator),
                    len(seen) + torch.randint(len(old), (batch_size - half,), generator=generator),
                ]
            )
            value = potential_loss(net, targets.rows(rows), effort_spread)
            optimiser.zero_grad()
            value.backward()
            torch.nn.utils.clip_grad_norm_(net.parameters(), 10.0)
            optimiser.step()
            schedule.step()
        if not np.isfinite(value.item()):
            raise DataError(f"online training of member {member} diverged: its loss is {value.item()}")
        tuned.append({k: v.detach().numpy().copy() for k, v in net.state_dict().items()})
    tensors = stack_members(tuned, scales)
    card = _widened(model, Model(robot, tensors, model.card), data, withheld)
    digest = _digest(data, COLUMNS)
    card["data_sha256"] = hashlib.sha256(f"{model.card.get('data_sha256')}{digest}".encode()).hexdigest()
    card["online"] = {
        "parent_data_sha256": model.card.get("data_sha256"),
        "parent_weights_sha256": _digest(model.tensors, sorted(model.tensors)),
        "parent_domain": model.card["domain"],
        "states_sha256": digest,
        "rows": len(data["rest"]),
        "states": len(data["rest"]) - int(np.sum(data["rest"])),
        "unstable_states_left_out": len(data["rest"]) - len(new),
        "withheld_states": int(withheld.sum()),
        "steps": steps,
        "learning_rate": learning_rate,
        "batch_size": batch_size,
        "rehearsal": rehearsal,
        "seed": seed,
        "seconds": round(time.perf_counter() - start, 2),
    }
    return Model(robot, tensors, card)


def is_tuned_from(model: Model, parent: Model, data: Mapping[str, np.ndarray], steps: int, seed: int) -> bool:
    """Return whether a model is the result of `fine_tune(parent, ...)` on the first rows of ``data``."""
    online = model.card.get("online", {})
    rows = online.get("rows", 0)
    return bool(
        0 < rows <= len(data["rest"])
        and (online["steps"], online["seed"]) == (steps, seed)
        and online.get("parent_domain") == parent.card["domain"]
        and online["parent_weights_sha256"] == _digest(parent.tensors, sorted(parent.tensors))
        and online["states_sha256"] == _digest({k: v[:rows] for k, v in data.items()}, COLUMNS)
    )


def _digest(arrays: Mapping[str, np.ndarray], names: Iterable[str]) -> str:
    """Return the SHA-256 digest of arrays, in the order of their names."""
    digest = hashlib.sha256()
    for name in names:
        digest.update(np.ascontiguousarray(arrays[name]).tobytes())
    return digest.hexdigest()


def _member(tensors: Mapping[str, np.ndarray], member: int) -> dict[str, np.ndarray]:
    """Return the weights of one member, as an ensemble of one."""
    return {k: v if k.startswith("scale.") or k == "rest" else v[member : member + 1] for k, v in tensors.items()}


def _widened(before: Model, after: Model, data: Mapping[str, np.ndarray], withheld: np.ndarray) -> dict[str, Any]:
    """Return the card of a model after it learned states; ``withheld`` marks the stable ones that no member saw."""
    robot, names = before.robot, before.robot.design_space.names
    stable = stable_rows(robot, data)
    left_out = {name: data[name][~stable] for name in ("design", "displacement")}
    data = {name: data[name][stable] for name in COLUMNS}
    card = {k: v for k, v in before.card.items() if k not in _OF_TRAINING}
    domain = json.loads(json.dumps(card["domain"]))
    for k, box in enumerate(domain["displacement"]):
        domain["displacement"][k] = _grown(box, data["displacement"][:, k])
    for name, box in domain["design"].items():
        domain["design"][name] = _grown(box, data["design"][:, names.index(name)])
    if "growth" in domain:
        learned, beyond = (
            after.softening_ratio(after.context(d["design"]), d["displacement"]) for d in (data, left_out)
        )
        bound = min(GROWTH, float(beyond.min(initial=np.inf)))
        domain["growth"] = max(domain["growth"], min(float(learned.max()), bound))
    if withheld.any():
        designs, displacement, truth = (data[k][withheld] for k in ("design", "displacement", "effector"))
        context = after.context(designs)
        _, effector, spread = after.state(context, displacement)
        error = np.linalg.norm((effector - truth).reshape(len(truth), -1, 3), axis=2).max(axis=1)
        uncertainty = np.maximum(after.trust(context, displacement, spread)[0], 0.25 * domain["limit"])
        domain["inflation"] *= max(1.0, float(np.quantile(error / uncertainty, 0.95)))
    card["domain"] = domain
    return card


def _grown(box: list[float], values: np.ndarray) -> list[float]:
    return [min(box[0], float(values.min())), max(box[1], float(values.max()))]
