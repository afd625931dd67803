"""SoftGym-CoDesign: frozen problems on which algorithms for design and control are compared.

`load_problem` returns a problem, `Search` scores bodies within its budget, `submit` makes the one JSON file of a
submission, and `verify` runs its winner again on finite elements.
"""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports

if TYPE_CHECKING:
    from softgym_envs.extensions.leaderboard.frozen import FrozenProblem as FrozenProblem
    from softgym_envs.extensions.leaderboard.frozen import load_problem as load_problem
    from softgym_envs.extensions.leaderboard.frozen import problem_names as problem_names
    from softgym_envs.extensions.leaderboard.problem import JudgedScore as JudgedScore
    from softgym_envs.extensions.leaderboard.search import Search as Search
    from softgym_envs.extensions.leaderboard.submission import Submission as Submission
    from softgym_envs.extensions.leaderboard.submission import submit as submit
    from softgym_envs.extensions.leaderboard.submission import verify as verify

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "frozen": ["FrozenProblem", "load_problem", "problem_names"],
        "problem": ["JudgedScore"],
        "search": ["Search"],
        "submission": ["Submission", "submit", "verify"],
    },
)
