"""The report of a study: one HTML file."""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports

if TYPE_CHECKING:
    from softgym_envs.extensions.report.page import write_report as write_report

__getattr__, __dir__, __all__ = lazy_exports(__name__, {"page": ["write_report"]})
