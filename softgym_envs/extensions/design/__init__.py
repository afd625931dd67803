"""Design without a controller: metrics of a body, their sensitivity, search, gradients, and calibration from data.

All of it reads the condensed model alone (thesis, sections 3.2 to 3.4 and 4.5), on FEM or on a learned surrogate.
"""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports

if TYPE_CHECKING:
    from softgym_envs.extensions.design.calibration import calibrate as calibrate
    from softgym_envs.extensions.design.config import CalibrationConfig as CalibrationConfig
    from softgym_envs.extensions.design.config import OptimiseConfig as OptimiseConfig
    from softgym_envs.extensions.design.config import SensitivityConfig as SensitivityConfig
    from softgym_envs.extensions.design.gradient import optimise as optimise
    from softgym_envs.extensions.design.gradient_free import search as search
    from softgym_envs.extensions.design.measurements import measure as measure
    from softgym_envs.extensions.design.metrics import ActuationPath as ActuationPath
    from softgym_envs.extensions.design.sensitivity import analyse_sensitivity as analyse_sensitivity

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "calibration": ["calibrate"],
        "config": ["CalibrationConfig", "OptimiseConfig", "SensitivityConfig"],
        "gradient": ["optimise"],
        "measurements": ["measure"],
        "metrics": ["ActuationPath"],
        "gradient_free": ["search"],
        "sensitivity": ["analyse_sensitivity"],
    },
)
