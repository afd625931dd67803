"""The search loop of studies, design searches and the benchmark.

A search has a ledger, which records what every body scored and says which bodies come next: its proposer (a sampler of
Optuna, or anything else that can ask and tell) chooses them as long as the budget allows. An evaluator scores them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Protocol, TypeVar

Proposal = TypeVar("Proposal")
Outcome = TypeVar("Outcome", contravariant=True)


class Ledger(Protocol[Proposal, Outcome]):
    """Record of a search: what was scored, and what comes next."""

    def ask(self) -> Sequence[Proposal]:
        """Return the bodies to score next; none if the search is over."""

    def tell(self, proposal: Proposal, outcome: Outcome) -> None:
        """Record what a body scored."""


def run_search(
    ledger: Ledger[Proposal, Outcome],
    evaluate: Callable[[Sequence[Proposal]], Iterable[tuple[Proposal, Outcome]]],
) -> None:
    """Score bodies until the ledger asks for none.

    Args:
        ledger: proposes and records.
        evaluate: yields proposals with their outcomes, in any order; one that it leaves out is not recorded.
    """
    while proposals := ledger.ask():
        for proposal, outcome in evaluate(proposals):
            ledger.tell(proposal, outcome)
