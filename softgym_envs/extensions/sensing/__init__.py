"""Estimation of the shape of a soft robot, and of the loads on it, from its sensors (thesis, sec. 3.3.6)."""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports

if TYPE_CHECKING:
    from softgym_envs.extensions.sensing.estimator import Estimator as Estimator
    from softgym_envs.extensions.sensing.learned import LearnedEstimator as LearnedEstimator
    from softgym_envs.extensions.sensing.loads import Payload as Payload
    from softgym_envs.extensions.sensing.loads import Touch as Touch
    from softgym_envs.extensions.sensing.loads import TouchGrid as TouchGrid
    from softgym_envs.extensions.sensing.loads import finger_grid as finger_grid
    from softgym_envs.extensions.sensing.model_errors import RowErrors as RowErrors
    from softgym_envs.extensions.sensing.model_errors import measured_errors as measured_errors
    from softgym_envs.extensions.sensing.readings import Noise as Noise
    from softgym_envs.extensions.sensing.readings import Readings as Readings

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "estimator": ["Estimator"],
        "learned": ["LearnedEstimator"],
        "loads": ["Payload", "Touch", "TouchGrid", "finger_grid"],
        "model_errors": ["RowErrors", "measured_errors"],
        "readings": ["Noise", "Readings"],
    },
)
