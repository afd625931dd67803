"""softgym-envs: Gymnasium environments in which a soft robot's body and its controller are optimised together.

Importing this package registers every environment ID and imports nothing heavy.

Public is what `softgym_envs` and its packages `mechanics`, `robots`, `surrogate`, `backends`, `control`, `estimation`,
`envs`, `agents`, `codesign` and `viewer` export, and the exceptions in `softgym_envs.errors`. Every other module and
name may change without notice. docs/architecture.md says what each package does.
"""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports
from softgym_envs.envs.registration import register_environments

if TYPE_CHECKING:
    from softgym_envs.designs import DesignSpace as DesignSpace
    from softgym_envs.designs import DesignVariable as DesignVariable
    from softgym_envs.envs.registration import ENVIRONMENTS as ENVIRONMENTS
    from softgym_envs.envs.registration import register_environment as register_environment
    from softgym_envs.envs.tasks.registry import register_task as register_task
    from softgym_envs.errors import ConvergenceError as ConvergenceError
    from softgym_envs.errors import InfeasibleDesign as InfeasibleDesign
    from softgym_envs.errors import SoftGymError as SoftGymError
    from softgym_envs.quantities import unchecked as unchecked
    from softgym_envs.robots.registry import make_robot as make_robot
    from softgym_envs.robots.registry import register_robot as register_robot
    from softgym_envs.version import __version__ as __version__

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "designs": ["DesignSpace", "DesignVariable"],
        "envs.registration": ["ENVIRONMENTS", "register_environment"],
        "envs.tasks.registry": ["register_task"],
        "errors": ["ConvergenceError", "InfeasibleDesign", "SoftGymError"],
        "quantities": ["unchecked"],
        "robots.registry": ["make_robot", "register_robot"],
        "version": ["__version__"],
    },
)

register_environments()
