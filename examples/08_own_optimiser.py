"""An optimiser of your own on a problem of the benchmark: a hill climber, and the submission that it makes."""

import numpy as np

from softgym_envs.extensions.leaderboard import Search, load_problem, submit

problem = load_problem("finger-zone-v1")
search = Search(problem, level="small", judge="shared")  # a shared policy: milliseconds a body
rng = np.random.default_rng(0)
best, point, step = -np.inf, np.zeros(len(problem.variables)), 0.6
while search.open:
    candidate = np.clip(point + step * rng.standard_normal(len(point)), -1.0, 1.0)
    score = search.evaluate(problem.design(candidate))
    if score.score > best:
        best, point = score.score, candidate
    else:
        step *= 0.95
submission = submit(search, "hill climber", author="you", test=True)  # on finite elements: seconds
submission.write("submission.json")
print(f"{len(search.ledger)} bodies, mean distance {-1e3 * best:.2f} mm: {submission.designs[0]}")
print("check it with: softgym benchmark verify submission.json")
print("see where it stands with: softgym benchmark board submission.json")
