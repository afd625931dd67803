"""Environments: a robot, a task and a backend behind the Gymnasium interface, one at a time or many at once."""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports

if TYPE_CHECKING:
    from softgym_envs.envs.env import SoftRobotEnv as SoftRobotEnv
    from softgym_envs.envs.options import EnvironmentOptions as EnvironmentOptions
    from softgym_envs.envs.registration import ENVIRONMENTS as ENVIRONMENTS
    from softgym_envs.envs.registration import register_environment as register_environment
    from softgym_envs.envs.spaces import AgentSpaces as AgentSpaces
    from softgym_envs.envs.tasks.base import Task as Task
    from softgym_envs.envs.tasks.carry import Carry as Carry
    from softgym_envs.envs.tasks.reach import Reach as Reach
    from softgym_envs.envs.tasks.registry import TASKS as TASKS
    from softgym_envs.envs.tasks.registry import make_task as make_task
    from softgym_envs.envs.tasks.registry import register_task as register_task
    from softgym_envs.envs.tasks.track import Track as Track
    from softgym_envs.envs.torch_env import TorchVectorEnv as TorchVectorEnv
    from softgym_envs.envs.vector_env import SoftRobotVectorEnv as SoftRobotVectorEnv

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "env": ["SoftRobotEnv"],
        "options": ["EnvironmentOptions"],
        "registration": ["ENVIRONMENTS", "register_environment"],
        "spaces": ["AgentSpaces"],
        "tasks.base": ["Task"],
        "tasks.carry": ["Carry"],
        "tasks.reach": ["Reach"],
        "tasks.registry": ["TASKS", "make_task", "register_task"],
        "tasks.track": ["Track"],
        "torch_env": ["TorchVectorEnv"],
        "vector_env": ["SoftRobotVectorEnv"],
    },
)
