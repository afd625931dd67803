"""Environments on the surrogate in torch: a hundred thousand bodies at once on a GPU, without copies to the host.

The same environments as `SoftRobotVectorEnv`, with tensors in place of arrays. A step runs the same few Newton
iterations for every row, needed or not, and never waits for the host, so it can be captured as a CUDA graph or
compiled. After the step the host checks once whether an episode ended or a search is unfinished; the few rows whose
search takes longer are then finished separately.

Internally, reached displacements ``u`` are scaled to [-1, 1] over the actuators' ranges, as the networks take them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import torch
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from torch import Tensor

from softgym_envs.envs.arrays import with_tensors
from softgym_envs.envs.options import (
    EnvironmentOptions,
    Setup,
    check_autoreset,
    check_counts,
    check_design_option,
    check_reset_options,
    check_seeds,
    complete_bodies,
    set_up,
    take_reset_mask,
    task_by_row,
)
from softgym_envs.envs.registration import ENVIRONMENTS, EnvironmentRow, find_row
from softgym_envs.envs.tasks.base import draw_paths
from softgym_envs.extensions.gpu.parts import TorchParts
from softgym_envs.extensions.gpu.surrogates import Bodies, State, TorchBatch, put_rows, repeat_body, take_rows
from softgym_envs.robots.registry import ROBOTS
from softgym_envs.surrogate.pretrained import standalone_model

if TYPE_CHECKING:
    from softgym_envs.envs.registration import RobotSource, TaskSource

Result = dict[str, Any]


class TorchVectorEnv(VectorEnv[Tensor, Tensor, Tensor]):
    """``num_envs`` copies of an environment on the surrogate, stepped together on one device.

    As `SoftRobotVectorEnv`, with tensors on ``device`` in place of arrays; ``info["final_obs"]`` has a row for each
    sub-environment, and ``info["_final_obs"]`` marks those that ended. Later steps do not overwrite returned tensors.
    It is made for GPUs: on a CPU, `gymnasium.make_vec` is several times faster.

    Args:
        id: ID of an environment on the surrogate.
        num_envs: number of sub-environments.
        device: device of all tensors: ``"cuda"``, ``"cpu"``, ...
        dtype: type of the networks and all results; ``torch.float32`` or ``torch.float64``.
        seed: seed of the first `reset`.
        compile: compile the step with ``torch.compile``; the first step then takes about a minute.
        cuda_graph: capture the step as a CUDA graph and replay it; for CUDA devices.
        max_episode_steps: time limit; default that of the ID.
        autoreset_mode: ``"SameStep"``, ``"NextStep"`` or ``"Disabled"``.
        robot: replaces that of the ID; see `SoftRobotEnv`.
        task: replaces that of the ID; its methods must take tensors, see `Task`.
        **options: ``design``, ``action_mode`` and the other arguments that the page of each environment ID lists.

    Raises:
        ValueError: for an unsupported ID, task, network, device or option.
        DesignError: for a malformed design.
        WeightsError: if no weights ship for the robot, its actuators have a largest effort, or the weights have fewer
            members than ``backend_options`` requests.
    """

    def __init__(
        self,
        id: str,
        num_envs: int = 1,
        *,
        device: str | torch.device = "cuda",
        dtype: torch.dtype = torch.float32,
        seed: int | None = None,
        compile: bool = False,
        cuda_graph: bool = False,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        robot: RobotSource | None = None,
        task: TaskSource | None = None,
        **options: Any,
    ) -> None:
        check_counts(num_envs, max_episode_steps)
        self.device = torch.device(device)
        _check_torch(self.device, dtype, cuda_graph)
        row = find_row(id)
        setup = set_up(
            robot or row.robot, task or row.task, _backend_of(row), EnvironmentOptions.check(row.defaults | options)
        )
        _check_setup(id, setup)
        self.robot, self.task = setup.robot, setup.task
        self._model = _model_of(setup, self.device, dtype)
        self.spaces = setup.spaces(moving=self._model.moving)
        self.design_space = self.robot.design_space
        self.num_envs, self.dtype = num_envs, dtype
        self.max_episode_steps = row.max_episode_steps if max_episode_steps is None else max_episode_steps
        self.single_action_space = self.spaces.action_space
        self.single_observation_space = self.spaces.observation_space
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.autoreset_mode = check_autoreset(autoreset_mode)
        self.metadata = {"autoreset_mode": self.autoreset_mode, "render_modes": []}
        self.render_mode, self.spec = None, gymnasium.spec(id)
        self._task, self._spaces = with_tensors(self.task, self._put), with_tensors(self.spaces, self._put)

        # Designs are kept in double precision: near 0.5 a Poisson's ratio needs its digits.
        variables = list(self.design_space)
        self._log = torch.tensor([v.log for v in variables], device=self.device)
        self._bounds = self._put_double([[v.low, v.high] for v in variables]).T
        self._ends = torch.where(self._log, torch.log(self._bounds), self._bounds)
        self._sampled = [self.design_space.names.index(name) for name in setup.sampled]
        self._shown = [self.design_space.names.index(name) for name in setup.shown]
        self._fixed = self._put_double(setup.design.array)

        self._generator = torch.Generator(self.device)
        self._generator.seed()
        self._random = _TorchRandom(self._generator, dtype)
        self._first_seed = seed
        self._compile, self._cuda_graph = compile, cuda_graph
        #: The prepared step (eager, compiled or captured); None if it must be prepared again, because tensors moved in
        #: memory.
        self._advance_fast: Callable[[Tensor], Result] | None = None
        self.designs = self._fixed.expand(num_envs, -1).clone()
        self._changed = torch.zeros(num_envs, dtype=torch.bool, device=self.device)
        # One body for all rows, until they differ.
        self._bodies = self._prepare(self._fixed[None])
        self._state = self._at_rest(self._bodies, num_envs)
        self._started = False
        #: Rows whose episodes are over and not reset yet; None if there are none.
        self._ended: Tensor | None = None

    def __getstate__(self) -> dict[str, Any]:
        # The prepared step works on the tensors of this object; a copy prepares its own.
        return {**self.__dict__, "_advance_fast": None}

    def _put(self, values: Any) -> Tensor:
        return torch.as_tensor(np.array(values, dtype=float), dtype=self.dtype, device=self.device)

    def _put_double(self, values: Any) -> Tensor:
        return torch.as_tensor(np.array(values, dtype=float), device=self.device)

    # -- bodies -----------------------------------------------------------------------------------------------------

    def _prepare(self, designs: Tensor) -> Bodies:
        """Return bodies and their observed designs, from designs (S, len(space)) in double precision."""
        low, high = self._ends
        unit = 2.0 * (torch.where(self._log, torch.log(designs), designs) - low) / (high - low) - 1.0
        return self._model.prepare(designs) | {"unit": unit[:, self._shown].to(self.dtype)}

    def _set_bodies(self, index: Tensor, designs: Tensor) -> None:
        """Give the rows ``index`` new bodies: one for all of them (1, len(space)), or one each."""
        self.designs[index] = designs
        new, old = self._prepare(designs), self._bodies
        if len(designs) == 1 and len(index) == self.num_envs:
            if len(old["rest"]) == 1:
                for name, value in new.items():
                    old[name].copy_(value)  # a captured graph reads them from this memory
            else:
                self._bodies, self._advance_fast = new, None
            return
        if len(old["rest"]) != self.num_envs:
            self._bodies = repeat_body(old, self.num_envs)
            self._advance_fast = None
        put_rows(self._bodies, index, new)

    def _draw_designs(self, count: int) -> Tensor:
        low, high = self._ends[:, self._sampled]
        shape = (count, len(self._sampled))
        share = torch.rand(shape, generator=self._generator, dtype=torch.float64, device=self.device)
        drawn = low + (high - low) * share
        drawn = torch.where(self._log[self._sampled], torch.exp(drawn), drawn)
        low, high = self._bounds[:, self._sampled]
        designs = self._fixed.expand(count, -1).clone()
        designs[:, self._sampled] = torch.minimum(torch.maximum(drawn, low), high)
        return designs

    # -- episodes ---------------------------------------------------------------------------------------------------

    def _at_rest(self, bodies: Bodies, count: int) -> dict[str, Tensor]:
        """Return the state of ``count`` rows at the beginning of an episode, without their goals."""
        n = self._model.count
        parts = {
            "command": torch.zeros(1, n, dtype=self.dtype, device=self.device),
            **self._model.at_rest(bodies),
            "converged": torch.ones(1, dtype=torch.bool, device=self.device),
            "steps": torch.zeros(1, dtype=torch.int64, device=self.device),
            "paths": torch.zeros(1, 1, 3, dtype=self.dtype, device=self.device),
            "counts": torch.ones(1, dtype=torch.int64, device=self.device),
        }
        return {name: part.expand(count, *part.shape[1:]).clone() for name, part in parts.items()}

    def _begin_episodes(self, index: Tensor, designs: Tensor | None = None, paths: Tensor | None = None) -> None:
        """Start episodes in the rows ``index``."""
        if designs is not None:
            self._set_bodies(index, designs)
            self._changed[index] = True
        elif self._sampled:
            self._set_bodies(index, self._draw_designs(len(index)))
        elif bool(self._changed[index].any()):
            self._set_bodies(index, self._fixed[None])
            self._changed[index] = False
        bodies = take_rows(self._bodies, index)
        if paths is None:
            paths = draw_paths(self._task, index, lambda rows: self._random, self._kinematics)
        if paths.shape[1] > self._state["paths"].shape[1]:
            self._state["paths"] = self._state["paths"].new_zeros(self.num_envs, *paths.shape[1:])
            self._advance_fast = None
        rest = self._at_rest(bodies, len(index))
        del rest["paths"]
        rest["counts"].fill_(paths.shape[1])
        for name, value in rest.items():
            self._state[name][index] = value
        self._state["paths"][index, : paths.shape[1]] = paths

    def _kinematics(self, index: Tensor, commands: Tensor) -> Tensor:
        """Return the effectors [m] (B, 3) of rows (B,) under commands (B, n_a); NaN where no equilibrium is found."""
        return self._model.kinematics(take_rows(self._bodies, index), commands)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Tensor, dict[str, Any]]:
        """Start an episode in every sub-environment.

        Args:
            seed: seed of all random numbers from here on, or a list of ``num_envs`` seeds to make it from; by default
                the sequence continues, beginning with the seed of the constructor.
            options: ``"design"``: one body for all for one episode, a mapping, or one for each: a list of them, or
                the values of all design variables in their order, shape (num_envs, len(design_space)); ``"goal"``: a
                point (3,) or a path (p, 3) [m] for all, or a path for each (num_envs, p, 3); ``"reset_mask"``: which
                sub-environments to reset, boolean (num_envs,); default all.

        Returns:
            Observation (num_envs, d) and info.

        Raises:
            DesignError: for a malformed design.
            ValueError: for an unknown option, a malformed seed, goal or mask, or another number of seeds.
        """
        rows, options = take_reset_mask({name: _array(value) for name, value in (options or {}).items()}, self.num_envs)
        design, goal = check_reset_options(options)
        index = torch.as_tensor(rows, device=self.device)
        paths = designs = None
        if goal is not None:
            paths = self._put(self.task.check_paths(goal, () if np.ndim(goal) < 3 else (self.num_envs,)))
            paths = paths.expand(self.num_envs, *paths.shape[-2:])[index]
        if design is not None:
            designs = self._check_designs(design)
            designs = designs if len(designs) == 1 else designs[index]
        seeds = [one for one in check_seeds(seed, self.num_envs) if one is not None]
        if seeds:
            self._generator.manual_seed(int(np.random.SeedSequence(seeds).generate_state(1)[0]))
        elif self._first_seed is not None:
            self._generator.manual_seed(self._first_seed)
        self._first_seed = None
        self._begin_episodes(index, designs, paths)
        self._started = True
        if self._ended is not None:
            self._ended[index] = False
        report = self._report(self._bodies, self._state)
        return report["observation"], report["info"]

    def _random_seed(self) -> int:
        return int(torch.randint(2**31, (1,), generator=self._generator, device=self.device))

    def _check_designs(self, design: Any) -> Tensor:
        bodies = [design] if isinstance(design, Mapping) else design
        if isinstance(bodies, Sequence) and all(isinstance(body, Mapping) for body in bodies):
            check_design_option(design, self.num_envs)
            fixed = dict(zip(self.design_space.names, self._fixed.tolist(), strict=True))
            values = complete_bodies(self.design_space, design, fixed, np.arange(len(bodies)))
        else:
            values = np.asarray(design, dtype=float)
            shape = (self.num_envs, len(self.design_space))
            if values.shape != shape:
                raise ValueError(f"design must be a mapping or an array of shape {shape}, got {values.shape}")
            for variable, column in zip(self.design_space, values.T, strict=True):
                variable.check(column.min()), variable.check(column.max())
        return self._put_double(values)

    # -- steps ------------------------------------------------------------------------------------------------------

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Apply actions (num_envs, n_a) in [-1, 1].

        Returns:
            Observation (num_envs, d), reward, terminated and truncated (num_envs,), and info.

        Raises:
            ResetNeeded: before the first `reset`, or without autoreset if an episode is over.
            ValueError: for actions with a wrong shape or values that are not finite.
        """
        if not self._started:
            raise ResetNeeded("step was called before reset")
        if self.autoreset_mode == AutoresetMode.DISABLED and self._ended is not None and bool(self._ended.any()):
            over = torch.nonzero(self._ended)[:, 0].tolist()
            raise ResetNeeded(f"the episodes of sub-environments {over} are over; reset them with a reset_mask")
        actions = torch.as_tensor(actions, dtype=self.dtype, device=self.device)
        shape = (self.num_envs, self._model.count)
        if actions.shape != shape:
            raise ValueError(f"actions must have shape {shape}, got {tuple(actions.shape)}")
        if self._advance_fast is None:
            self._advance_fast = self._prepare_step(actions)
        result = self._advance_fast(actions)
        # The only point where a step waits for the device, unless an episode ends.
        finite, found, ended = result["flags"].tolist()
        if not finite:
            raise ValueError("actions must be finite; allowed: -1 to 1")
        if not found:
            result = self._finish(result)
            ended = bool(result["truncated"].any())
        for name, value in result["state"].items():
            self._state[name].copy_(value)
        observation, info, truncated = result["observation"], result["info"], result["truncated"]
        reward = result["reward"]
        if self.autoreset_mode != AutoresetMode.SAME_STEP:
            if self._ended is not None:  # these rows are reset in place of the step
                rows = torch.nonzero(self._ended)[:, 0]
                reward, truncated = torch.where(self._ended, 0.0, reward), truncated & ~self._ended
                if len(rows):
                    self._begin_episodes(rows)
                    report = self._report(self._bodies, self._state)
                    observation, info = report["observation"], report["info"]
            self._ended = truncated.clone() if ended else None
        elif ended:
            final, mask = {"final_obs": observation, "final_info": info}, truncated
            self._begin_episodes(torch.nonzero(mask)[:, 0])
            report = self._report(self._bodies, self._state)
            observation = report["observation"]
            info = {**report["info"], **final, **{f"_{name}": mask for name in final}}
        return observation, reward, torch.zeros_like(truncated), truncated, info

    def _prepare_step(self, actions: Tensor) -> Callable[[Tensor], Result]:
        """Return the step as it is, compiled, or captured as a CUDA graph."""
        advance: Callable[..., Result] = self._advance
        if self._compile:
            advance = torch.compile(advance, dynamic=False)
        bodies, state = self._bodies, self._state
        if not self._cuda_graph:
            return lambda actions: advance(bodies, state, actions)
        # The graph reads state and bodies from their present memory, and writes only its result.
        given, stream = actions.clone(), torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(3):
                advance(bodies, state, given)
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            result = advance(bodies, state, given)

        def replay(actions: Tensor) -> Result:
            given.copy_(actions)
            graph.replay()
            return _map(torch.clone, result)

        return replay

    def _advance(self, bodies: Bodies, state: State, actions: Tensor) -> Result:
        """Return the result of a step with the same few Newton steps in every row; it changes nothing."""
        command = self._spaces.command(actions.clamp(-1.0, 1.0), state["command"])
        new, found = self._model.advance(bodies, state, command)
        result = self._new_state(bodies, state, {"command": command, **new}, found)
        flags = torch.stack([torch.isfinite(actions).all(), found.all(), result["truncated"].any()])
        return result | {"flags": flags, "search": ({"command": command, **new}, found)}

    def _finish(self, result: Result) -> Result:
        """Continue the search where the fixed number of Newton steps was not enough."""
        new, found = result["search"]
        rows = torch.nonzero(~found)[:, 0]
        state = {name: value[rows] for name, value in self._state.items()}
        more, solved = self._model.finish(take_rows(self._bodies, rows), state, new["command"][rows])
        new = {name: value.index_copy(0, rows, more[name]) if name in more else value for name, value in new.items()}
        return self._new_state(self._bodies, self._state, new, found.index_copy(0, rows, solved))

    def _new_state(self, bodies: Bodies, state: State, new: State, found: Tensor) -> Result:
        """Return the state after a search, with observation, reward, info and the rows that end."""
        # Rows without an equilibrium keep their state, and their episodes end.
        new = {
            name: torch.where(found.reshape(-1, *(1,) * (value.ndim - 1)), value, state[name])
            for name, value in new.items()
        }
        new |= {"converged": found, "steps": state["steps"] + 1}
        truncated = (new["steps"] >= self.max_episode_steps) | ~found
        report = self._report(bodies, state | new)
        report["reward"] = torch.where(found, report["reward"], 0.0)
        return report | {"state": new, "truncated": truncated}

    def _report(self, bodies: Bodies, state: dict[str, Tensor]) -> Result:
        """Return observation, reward and info of a state."""
        command, effort, effector = state["command"], state["effort"], state["effector"]
        displacement = self._model.middle + self._model.half_range * state["u"]
        goal = self._task.goals(state["paths"], state["counts"], state["steps"])
        aim = self._task.goals(state["paths"], state["counts"], state["steps"] + self._task.lookahead)
        distance, terms, reward = self._task.rate(effector, goal, self._spaces.effort_share(effort))
        unit_design = bodies["unit"].expand(self.num_envs, -1)
        info = {
            "effector": effector.clone(),
            "goal": goal.clone(),
            "distance": distance,
            "is_success": distance < self.task.success_distance,
            **{f"reward_{name}": term for name, term in terms.items()},
            "displacement": displacement,
            "effort": effort.clone(),
            "stable": torch.ones_like(state["converged"]),
            "uncertainty": state["uncertainty"].clone(),
            "trusted": state["trusted"].clone(),
            "converged": state["converged"].clone(),
        }
        observation = self._spaces.observe(
            command, displacement, effort, effector, aim, unit_design, state.get("velocity")
        )
        return {"observation": observation, "reward": reward, "info": info}


def _backend_of(row: EnvironmentRow) -> str | None:
    """Return the backend of an ID on tensors: bodies of learned parts have one, whatever the default of their ID is."""
    found = ROBOTS.resolve(row.robot) if isinstance(row.robot, str) else row.robot
    learning = getattr(found, "learning", None)
    return "surrogate" if learning is not None and learning.parts else row.backend


def _model_of(setup: Setup, device: torch.device, dtype: torch.dtype) -> TorchBatch | TorchParts:
    """Return what finds the states of many bodies: of learned parts, or of one learned model."""
    if setup.robot.learning.parts:
        return TorchParts(setup.robot, device, dtype, **setup.backend_options)
    return TorchBatch(standalone_model(setup.robot, **setup.backend_options), device, dtype)


def _check_torch(device: torch.device, dtype: torch.dtype, cuda_graph: bool) -> None:
    """Raise ValueError for a type that is not supported, or a device that is not there."""
    if dtype not in (torch.float32, torch.float64):
        raise ValueError(f"dtype = {dtype} is not supported; allowed: torch.float32, torch.float64")
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ValueError(
            f"device = '{device}' is not available here; allowed: 'cpu', on which gymnasium.make_vec is faster"
        )
    if cuda_graph and device.type != "cuda":
        raise ValueError(f"cuda_graph needs a CUDA device, got device = '{device}'")


def _check_setup(id: str, setup: Setup) -> None:
    """Raise ValueError for an environment that cannot be computed with tensors."""
    if setup.backend != "surrogate":
        supported = [name for name, other in ENVIRONMENTS.items() if _backend_of(other) == "surrogate"]
        raise ValueError(f"id = {id!r} is not an environment on the surrogate; allowed: {', '.join(supported)}")
    if setup.backend_options.get("dynamics", False) and not setup.robot.learning.parts:
        raise ValueError("dynamics is not available on tensors; allowed: False, or gymnasium.make_vec")
    setup.robot.needs_displacements("an environment on tensors")
    if setup.plants is not None:
        raise ValueError("plant is not available on tensors; allowed: None, or gymnasium.make_vec")
    if chosen := [name for name in setup.shown if setup.robot.design_space[name].choices]:
        raise ValueError(f"design_in_observation = {chosen} are choices, which this environment does not show")
    if does := task_by_row(setup.task):
        raise ValueError(f"task '{setup.task.name}' {does}, which tensors do not have; use gymnasium.make_vec")


class _TorchRandom:
    """Random numbers for tasks: the methods of `numpy.random.Generator` that they use, with tensors on a device."""

    def __init__(self, generator: torch.Generator, dtype: torch.dtype) -> None:
        self._generator, self._dtype = generator, dtype

    def uniform(self, low: Any, high: Any, size: Any) -> Tensor:
        device = self._generator.device
        low, high = (torch.as_tensor(bound, dtype=self._dtype, device=device) for bound in (low, high))
        return low + (high - low) * torch.rand(size, generator=self._generator, dtype=self._dtype, device=device)

    def integers(self, low: int, *, size: int) -> Tensor:
        return torch.randint(low, (size,), generator=self._generator, device=self._generator.device)


def _map(function: Callable[[Tensor], Tensor], tree: Any) -> Any:
    if isinstance(tree, dict):
        return {name: _map(function, value) for name, value in tree.items()}
    if isinstance(tree, tuple):
        return tuple(_map(function, value) for value in tree)
    return function(tree)


def _array(values: Any) -> Any:
    return values.detach().cpu().numpy() if isinstance(values, Tensor) else values
