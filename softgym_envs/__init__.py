"""softgym-envs: Gymnasium environments in which a soft robot's body and its controller are optimised together.

Importing this package registers every environment ID and imports nothing heavy.
"""

from softgym_envs.envs.registration import ENVIRONMENTS, register_environments
from softgym_envs.version import __version__

__all__ = ["ENVIRONMENTS", "__version__"]

register_environments()
