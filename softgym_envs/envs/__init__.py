"""Environments: a robot, a task and a backend behind the Gymnasium interface, one at a time or many at once."""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports

if TYPE_CHECKING:
    from softgym_envs.envs.env import SoftRobotEnv as SoftRobotEnv
    from softgym_envs.envs.registration import ENVIRONMENTS as ENVIRONMENTS
    from softgym_envs.envs.tasks.base import Task as Task
    from softgym_envs.envs.tasks.carry import Carry as Carry
    from softgym_envs.envs.tasks.reach import Reach as Reach
    from softgym_envs.envs.tasks.track import Track as Track
    from softgym_envs.envs.torch_env import TorchVectorEnv as TorchVectorEnv
    from softgym_envs.envs.vector_env import SoftRobotVectorEnv as SoftRobotVectorEnv

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "env": ["SoftRobotEnv"],
        "registration": ["ENVIRONMENTS"],
        "tasks.base": ["Task"],
        "tasks.carry": ["Carry"],
        "tasks.reach": ["Reach"],
        "tasks.track": ["Track"],
        "torch_env": ["TorchVectorEnv"],
        "vector_env": ["SoftRobotVectorEnv"],
    },
)
