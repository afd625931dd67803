"""A section of the reports of studies."""

from softgym_envs.extensions.report.page import ReportSection

SECTION = ReportSection("Pegs", lambda snapshot, results: f"<p>{len(snapshot.trials)} pegs were tried.</p>")
