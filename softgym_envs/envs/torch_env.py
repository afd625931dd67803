"""Environments on the surrogate wholly in torch: a hundred thousand bodies at once on a GPU, nothing leaves the device.

The same environments as `SoftRobotVectorEnv`, with tensors in place of arrays. A step is a fixed sequence of batched
matrix products over all rows and all members of the ensemble: every row takes the same few Newton iterations, whether
it needs them or not, and none of them asks the host. It can therefore be captured as a CUDA graph or compiled. After
it the host asks once whether an episode ended; the few rows whose search takes longer are then finished alone.

Inside, displacements are scaled to [-1, 1] over the actuators' ranges, as the networks and the observation have them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from softgym_envs.backends.torch_batch import MAX_NEWTON_STEPS, Bodies, TorchBatch, put_rows, repeat_body, take_rows
from softgym_envs.envs.env import design_names
from softgym_envs.envs.registration import ENVIRONMENTS
from softgym_envs.envs.spaces import Interface
from softgym_envs.envs.tasks.base import make_task
from softgym_envs.envs.tasks.reach import Reach
from softgym_envs.envs.tasks.track import Track
from softgym_envs.errors import ConvergenceError
from softgym_envs.robots import make_robot
from softgym_envs.surrogate.pretrained import pretrained_model

__all__ = ["TorchVectorEnv"]

#: Newton steps of every row, with one Hessian. With random actions 7 % of the rows of GripperPinch and 2 % of the cable
#: trunk's need more, and none of the others'.
STEPS = 4


class TorchVectorEnv:
    """``num_envs`` copies of an environment on the surrogate, stepped together on one device.

    `reset` and `step` are those of `gymnasium.vector.VectorEnv`, whose contract asks for arrays; here everything is a
    tensor on ``device``, so that it is none. Episodes that end are reset in the same step: the observation is the first
    of the next episode, and ``info["final_obs"]``, ``info["final_info"]`` hold the end of the last one;
    ``info["_final_obs"]`` says of which rows. What the step returns stays valid after the next one.

    Args:
        id: an environment ID whose backend is the surrogate, with the task reach or track.
        num_envs: number of sub-environments.
        device: where everything is: ``"cuda"``, ``"cpu"``, ...
        dtype: of the networks and all results; ``torch.float32`` or ``torch.float64``.
        members: how many members of the ensemble to use, fewer for speed; default all.
        seed: of the first `reset`.
        compile: compile the step with ``torch.compile``; the first step then takes a minute or so.
        cuda_graph: capture the step as a CUDA graph and replay it; for CUDA devices.
        max_episode_steps: time limit; default that of the ID.
        design: body of every episode unless sampled or given in `reset`.
        sample_design: draw the body at each reset: True for all variables, or their names.
        design_in_observation: show the body to the agent: True for all variables, or their names.
        action_mode: ``"increment"`` or ``"absolute"``, see `Interface`.
        robot_options: options of the robot, over those of the ID.
        task_options: options of the task, over those of the ID.

    Raises:
        ValueError: for an ID, a task, a network, a device or an option that is not supported.
        DesignError: for a malformed design.
        WeightsError: where no weights ship for the robot, or have not so many members.
    """

    def __init__(
        self,
        id: str,
        num_envs: int = 1,
        *,
        device: str | torch.device = "cuda",
        dtype: torch.dtype = torch.float32,
        members: int | None = None,
        seed: int | None = None,
        compile: bool = False,
        cuda_graph: bool = False,
        max_episode_steps: int | None = None,
        design: Mapping[str, float] | None = None,
        sample_design: bool | Sequence[str] = False,
        design_in_observation: bool | Sequence[str] = False,
        action_mode: str = "increment",
        robot_options: Mapping[str, Any] | None = None,
        task_options: Mapping[str, Any] | None = None,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs = {num_envs} must be at least 1")
        if max_episode_steps is not None and max_episode_steps < 1:
            raise ValueError(f"max_episode_steps = {max_episode_steps} must be at least 1")
        if dtype not in (torch.float32, torch.float64):
            raise ValueError(f"dtype = {dtype} is not supported; allowed: torch.float32, torch.float64")
        supported = [name for name, row in ENVIRONMENTS.items() if row.backend == "surrogate"]
        if id not in supported:
            raise ValueError(f"id = {id!r} is not an environment on the surrogate; allowed: {', '.join(supported)}")
        self.device = torch.device(device)
        if self.device.type == "cuda" and not torch.cuda.is_available():
            raise ValueError(f"device = {str(device)!r} is not available here; allowed: 'cpu'")
        if cuda_graph and self.device.type != "cuda":
            raise ValueError(f"cuda_graph needs a CUDA device, got device = {str(device)!r}")
        row = ENVIRONMENTS[id]
        self.robot = make_robot(row.robot, **{**row.robot_options, **(robot_options or {})})
        task = make_task(row.task, self.robot, **{**row.task_options, **(task_options or {})})
        if not isinstance(task, Reach | Track):
            raise ValueError(f"task '{row.task}' is not supported; allowed: reach, track")
        model = pretrained_model(self.robot, members=members)
        self.task: Reach | Track = task
        self.num_envs, self.dtype = num_envs, dtype
        self.max_episode_steps = row.max_episode_steps if max_episode_steps is None else max_episode_steps
        space = self.design_space = self.robot.design_space
        shown = design_names(space, design_in_observation)
        self.interface = Interface(self.robot, action_mode=action_mode, design_names=shown, axes=self.task.axes)
        self.single_action_space = self.interface.action_space
        self.single_observation_space = self.interface.observation_space

        def put(values: Any, kind: torch.dtype = dtype) -> Tensor:
            return torch.as_tensor(np.array(values, dtype=float), dtype=kind, device=self.device)

        self._model = TorchBatch(model, self.device, dtype)
        self._typical_effort = put(self.robot.effort_scale)
        self._rates, self._axes = (
            put(2.0 * self.interface.rates / (self.robot.upper - self.robot.lower)),
            put(self.task.axes),
        )

        # Bodies are kept in double precision: near 0.5 a Poisson's ratio needs its digits.
        variables = list(space)
        double = torch.float64
        self._log = torch.tensor([v.log for v in variables], device=self.device)
        self._ends = put([np.log([v.low, v.high]) if v.log else [v.low, v.high] for v in variables], double).T
        self._sampled = [space.names.index(name) for name in design_names(space, sample_design)]
        self._shown = [space.names.index(name) for name in shown]
        self._fixed = put(space.complete(design).array, double)

        self._generator = torch.Generator(self.device)
        self._generator.seed()
        self._first_seed = seed
        self._compile, self._cuda_graph = compile, cuda_graph
        self._hot: Callable[[Tensor], dict[str, Any]] | None = None
        self.designs = self._fixed.expand(num_envs, -1).clone()
        self._changed = torch.zeros(num_envs, dtype=torch.bool, device=self.device)
        # One body for all, until they differ.
        self._bodies = self._prepare(self._fixed[None])
        self._state = self._at_rest(self._bodies, num_envs)
        self._started = False

    # -- bodies -----------------------------------------------------------------------------------------------------

    def _prepare(self, designs: Tensor) -> Bodies:
        """Bodies, with what the observation shows of them, from designs (S, len(space)) in double precision."""
        low, high = self._ends
        unit = 2.0 * (torch.where(self._log, torch.log(designs), designs) - low) / (high - low) - 1.0
        return self._model.prepare(designs) | {"unit": unit[:, self._shown].to(self.dtype)}

    def _take_bodies(self, index: Tensor, designs: Tensor) -> None:
        """Give the rows ``index`` new bodies: one for all of them (1, len(space)), or one each."""
        self.designs[index] = designs
        new, old = self._prepare(designs), self._bodies
        if len(designs) == 1 and len(index) == self.num_envs:
            if len(old["rest"]) == 1:
                for name, value in new.items():
                    old[name].copy_(value)  # a captured graph reads them where they are
            else:
                self._bodies, self._hot = new, None
            return
        if len(old["rest"]) != self.num_envs:
            self._bodies = repeat_body(old, self.num_envs)
            self._hot = None
        put_rows(self._bodies, index, new)

    # -- episodes ---------------------------------------------------------------------------------------------------

    def _at_rest(self, bodies: Bodies, count: int) -> dict[str, Tensor]:
        """State of ``count`` rows at the beginning of an episode, without their goals."""
        n = self._model.count
        parts = {
            "command": (-self._model.middle / self._model.half_range)[None],
            "u": bodies["rest"],
            "effort": bodies["rest_effort"],
            "effector": bodies["rest_effector"],
            "slack": torch.zeros(1, n, dtype=torch.bool, device=self.device),
            "uncertainty": bodies["rest_uncertainty"],
            "trusted": bodies["rest_trusted"],
            "converged": torch.ones(1, dtype=torch.bool, device=self.device),
            "steps": torch.zeros(1, dtype=torch.int64, device=self.device),
            "paths": torch.zeros(1, 1, 3, dtype=self.dtype, device=self.device),
            "counts": torch.ones(1, dtype=torch.int64, device=self.device),
        }
        return {name: part.expand(count, *part.shape[1:]).clone() for name, part in parts.items()}

    def _uniform(self, low: float, high: float, *shape: int, dtype: torch.dtype | None = None) -> Tensor:
        draws = torch.rand(*shape, generator=self._generator, dtype=dtype or self.dtype, device=self.device)
        return low + (high - low) * draws

    def _begin_episodes(self, index: Tensor, designs: Tensor | None = None, paths: Tensor | None = None) -> None:
        """Start episodes in the rows ``index``."""
        if designs is not None:
            self._take_bodies(index, designs)
            self._changed[index] = True
        elif self._sampled:
            designs = self._fixed.expand(len(index), -1).clone()
            low, high = self._ends[:, self._sampled]
            drawn = low + (high - low) * self._uniform(0.0, 1.0, len(index), len(self._sampled), dtype=torch.float64)
            bounds = torch.where(self._log, torch.exp(self._ends), self._ends)[:, self._sampled]
            drawn = torch.where(self._log[self._sampled], torch.exp(drawn), drawn)
            designs[:, self._sampled] = torch.minimum(torch.maximum(drawn, bounds[0]), bounds[1])
            self._take_bodies(index, designs)
        elif bool(self._changed[index].any()):
            self._take_bodies(index, self._fixed[None])
            self._changed[index] = False
        bodies = take_rows(self._bodies, index)
        if paths is None:
            paths = self._draw_goals(bodies, len(index))
        if paths.shape[1] > self._state["paths"].shape[1]:
            self._state["paths"] = self._state["paths"].new_zeros(self.num_envs, *paths.shape[1:])
            self._hot = None
        rest = self._at_rest(bodies, len(index))
        del rest["paths"]
        rest["counts"].fill_(paths.shape[1])
        for name, value in rest.items():
            self._state[name][index] = value
        self._state["paths"][index, : paths.shape[1]] = paths

    def _draw_goals(self, bodies: Bodies, count: int) -> Tensor:
        """Paths [m] (count, p, 3), as the tasks draw them with NumPy."""

        def put(array: np.ndarray) -> Tensor:
            return torch.as_tensor(array, dtype=self.dtype, device=self.device)

        task = self.task
        if isinstance(task, Track):
            return put(task.path) + self._uniform(-task.jitter, task.jitter, count, 1, 3)
        if task.fixed_goals is not None:
            chosen = torch.randint(len(task.fixed_goals), (count,), generator=self._generator, device=self.device)
            return put(task.fixed_goals)[chosen][:, None]
        low, n = 2.0 * task.command_low - 1.0, self._model.count
        goals = torch.full((count, 3), torch.nan, dtype=self.dtype, device=self.device)
        for _ in range(51):
            lost = torch.isnan(goals[:, :1])  # commands without an equilibrium are drawn again
            if not bool(lost.any()):
                return (goals + self._uniform(-task.spread, task.spread, count, 3))[:, None]
            target = self._uniform(low, 1.0, count, n)
            u, _, found = self._model.search(bodies, target, target, MAX_NEWTON_STEPS, stop=True)
            drawn = torch.where(found[:, None], self._model.measure(bodies, u)[0], torch.nan)
            goals = torch.where(lost, drawn, goals)
        raise ConvergenceError("50 random commands in a row have no equilibrium: no goal can be drawn", fraction=0.0)

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Tensor, dict[str, Any]]:
        """Start an episode in every sub-environment.

        Args:
            seed: of all random numbers from here on; default they go on, from the constructor's seed if it has one.
            options: ``"design"``: the body of all for one episode, a mapping, or values of all design variables in
                their order for each, shape (num_envs, len(design_space)); ``"goal"``: a point (3,) or a path (p, 3)
                [m] for all, or a path for each (num_envs, p, 3).

        Returns:
            Observation (num_envs, d) and info.

        Raises:
            DesignError: for a malformed design.
            ValueError: for an unknown option or a malformed goal.
        """
        options = dict(options or {})
        unknown = set(options) - {"design", "goal"}
        if unknown:
            raise ValueError(f"unknown reset option '{sorted(unknown)[0]}'; allowed: design, goal")
        paths, designs = None, None
        if options.get("goal") is not None:
            goal = _array(options["goal"])
            paths = torch.as_tensor(
                self.task.check_paths(goal, () if np.ndim(goal) < 3 else (self.num_envs,)),
                dtype=self.dtype,
                device=self.device,
            )
            paths = paths.expand(self.num_envs, *paths.shape[-2:])
        if options.get("design") is not None:
            designs = self._check_designs(options["design"])
        seed = self._first_seed if seed is None else seed
        self._first_seed = None
        if seed is not None:
            self._generator.manual_seed(seed)
        self._begin_episodes(torch.arange(self.num_envs, device=self.device), designs, paths)
        self._started = True
        report = self._report(self._bodies, self._state)
        return report["observation"], report["info"]

    def _check_designs(self, design: Any) -> Tensor:
        if isinstance(design, Mapping):
            fixed = dict(zip(self.design_space.names, self._fixed.tolist(), strict=True))
            values = self.design_space.complete(design, fixed).array[None]
        else:
            values = np.asarray(_array(design), dtype=float)
            shape = (self.num_envs, len(self.design_space))
            if values.shape != shape:
                raise ValueError(f"design must be a mapping or an array of shape {shape}, got {values.shape}")
            for variable, column in zip(self.design_space, values.T, strict=True):
                variable.check(column.min()), variable.check(column.max())
        return torch.as_tensor(values, device=self.device)

    # -- steps ------------------------------------------------------------------------------------------------------

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Apply actions (num_envs, n_a) in [-1, 1].

        Returns:
            Observation (num_envs, d), reward, terminated and truncated (num_envs,), and info.

        Raises:
            RuntimeError: before the first `reset`.
            ValueError: for actions of a wrong shape or ones that are not finite.
        """
        if not self._started:
            raise RuntimeError("step was called before reset")
        actions = torch.as_tensor(actions, dtype=self.dtype, device=self.device)
        shape = (self.num_envs, self._model.count)
        if actions.shape != shape:
            raise ValueError(f"actions must have shape {shape}, got {tuple(actions.shape)}")
        if self._hot is None:
            self._hot = self._prepare_step(actions)
        result = self._hot(actions)
        # The only question to the host in a step without ends.
        finite, found, ended = result["questions"].tolist()
        if not finite:
            raise ValueError("actions must be finite; allowed: -1 to 1")
        if not found:
            result = self._finish(result)
            ended = bool(result["truncated"].any())
        for name, value in result["state"].items():
            self._state[name].copy_(value)
        observation, info, truncated = result["observation"], result["info"], result["truncated"]
        if ended:
            final, mask = {"final_obs": observation, "final_info": info}, truncated
            self._begin_episodes(torch.nonzero(mask)[:, 0])
            report = self._report(self._bodies, self._state)
            observation = report["observation"]
            info = {**report["info"], **final, **{f"_{name}": mask for name in final}}
        return observation, result["reward"], torch.zeros_like(truncated), truncated, info

    def _prepare_step(self, actions: Tensor) -> Callable[[Tensor], dict[str, Any]]:
        """The step as it is, compiled, or captured as a graph of the device."""
        advance: Callable[..., dict[str, Any]] = self._advance
        if self._compile:
            advance = torch.compile(advance, dynamic=False)
        bodies, state = self._bodies, self._state
        if not self._cuda_graph:
            return lambda actions: advance(bodies, state, actions)
        # State and bodies are read where they lie; nothing is written but the result.
        given, stream = actions.clone(), torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(3):
                advance(bodies, state, given)
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            result = advance(bodies, state, given)

        def replay(actions: Tensor) -> dict[str, Any]:
            given.copy_(actions)
            graph.replay()
            return _map(torch.clone, result)

        return replay

    def _advance(self, bodies: Bodies, state: dict[str, Tensor], actions: Tensor) -> dict[str, Any]:
        """One step of every row, with `STEPS` Newton steps; changes nothing."""
        a = actions.clamp(-1.0, 1.0)
        before = state["command"]
        if self.interface.action_mode == "increment":
            target = before + a * self._rates
        else:
            target = before + torch.minimum(torch.maximum(a - before, -self._rates), self._rates)
        target = target.clamp(-1.0, 1.0)
        u, gradient, found = self._model.search(bodies, target, _guess(state, target), STEPS)
        result = self._settle(bodies, state, target, u, gradient, found)
        questions = torch.stack([torch.isfinite(actions).all(), found.all(), result["truncated"].any()])
        return result | {"questions": questions, "search": (target, u, gradient, found)}

    def _finish(self, result: dict[str, Any]) -> dict[str, Any]:
        """Search again, and longer, where `STEPS` Newton steps were not enough."""
        target, u, gradient, found = result["search"]
        rows = torch.nonzero(~found)[:, 0]
        wanted, guess = target[rows], _guess(self._state, target)[rows]
        parts = self._model.search(take_rows(self._bodies, rows), wanted, guess, MAX_NEWTON_STEPS, stop=True)
        u, gradient, found = (x.index_copy(0, rows, part) for x, part in zip((u, gradient, found), parts, strict=True))
        return self._settle(self._bodies, self._state, target, u, gradient, found)

    def _settle(
        self, bodies: Bodies, state: dict[str, Tensor], target: Tensor, u: Tensor, gradient: Tensor, found: Tensor
    ) -> dict[str, Any]:
        """State after a search, and all that is said about it."""
        effector, uncertainty, trusted = self._model.measure(bodies, u)
        effort, slack = self._model.efforts(bodies, target, u, gradient)
        new = {
            "command": target,
            "u": u,
            "effort": effort,
            "effector": effector,
            "slack": slack,
            "uncertainty": uncertainty,
            "trusted": trusted,
        }
        # Rows without a state stay where they were, and their episodes end.
        new = {
            name: torch.where(found if value.ndim == 1 else found[:, None], value, state[name])
            for name, value in new.items()
        }
        new |= {"converged": found, "steps": state["steps"] + 1}
        truncated = (new["steps"] >= self.max_episode_steps) | ~found
        report = self._report(bodies, state | new)
        report["reward"] = torch.where(found, report["reward"], 0.0)
        return report | {"state": new, "truncated": truncated}

    def _report(self, bodies: Bodies, state: dict[str, Tensor]) -> dict[str, Any]:
        """Observation, reward and info of a state, laid out as `Interface.observe` and `Task` have them."""
        paths, counts, steps = state["paths"], state["counts"], state["steps"]
        if paths.shape[1] == 1:
            goal = paths[:, 0]
        else:
            index = torch.minimum(steps * counts // self.task.horizon, counts - 1)
            goal = paths.gather(1, index[:, None, None].expand(-1, 1, 3))[:, 0]
        effector, relative = state["effector"], state["effort"] / self._typical_effort
        error = self._axes * (goal - effector)
        distance = torch.linalg.vector_norm(error, dim=1)
        margins = self.task.success_distance, self.robot.workspace_scale
        near, far = (1.0 / (1.0 + 9.0 * (distance / m) ** 2) for m in margins)
        terms = {"distance": 0.5 * (near + far), "effort": 1.0 - 0.05 * relative.abs().mean(dim=1).clamp(0.0, 1.0)}
        error = error * (2.5 / self.robot.workspace_scale)
        reach = 1.25 * self.robot.size
        parts = (
            state["command"],
            state["u"],
            relative / (1.0 + relative.abs()),
            effector / reach,
            goal / reach,
            error / (1.0 + error.abs()),
            bodies["unit"].expand(self.num_envs, -1),
        )
        info = {
            "effector": effector.clone(),
            "goal": goal.clone(),
            "distance": distance,
            "is_success": distance < self.task.success_distance,
            "reward_terms": terms,
            "displacement": self._model.middle + self._model.half_range * state["u"],
            "effort": state["effort"].clone(),
            "stable": torch.ones_like(state["converged"]),
            "uncertainty": state["uncertainty"].clone(),
            "trusted": state["trusted"].clone(),
            "converged": state["converged"].clone(),
        }
        observation = torch.cat(parts, dim=1).clamp(-1.0, 1.0)
        return {"observation": observation, "reward": terms["distance"] * terms["effort"], "info": info}


def _guess(state: dict[str, Tensor], target: Tensor) -> Tensor:
    """Where a search begins: slack cables where they were, the others at their command."""
    return torch.where(state["slack"], torch.maximum(state["u"], target), target)


def _map(function: Callable[[Tensor], Tensor], tree: Any) -> Any:
    if isinstance(tree, dict):
        return {name: _map(function, value) for name, value in tree.items()}
    if isinstance(tree, tuple):
        return tuple(_map(function, value) for value in tree)
    return function(tree)


def _array(values: Any) -> Any:
    return values.detach().cpu().numpy() if isinstance(values, Tensor) else values
