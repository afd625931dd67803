"""Co-design: Optuna proposes bodies, each is scored with its controller, and the best are checked on FEM.

`run_study` runs a study, and `load_study` reads what it has found so far.
"""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports

if TYPE_CHECKING:
    from softgym_envs.codesign.config import StudyConfig as StudyConfig
    from softgym_envs.codesign.metrics.metric import Metric as Metric
    from softgym_envs.codesign.metrics.metric import metric as metric
    from softgym_envs.codesign.metrics.sources import Outcome as Outcome
    from softgym_envs.codesign.snapshot import load_study as load_study
    from softgym_envs.codesign.study import run_study as run_study

if __name__ != "softgym_envs.codesign":  # this folder is softgym_envs/codesign, by a link
    raise ImportError(f"the package is softgym_envs.codesign: import that in place of {__name__}")

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "config": ["StudyConfig"],
        "metrics.metric": ["Metric", "metric"],
        "metrics.sources": ["Outcome"],
        "snapshot": ["load_study"],
        "study": ["run_study"],
    },
)
