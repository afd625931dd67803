"""Co-design: the body is optimised outside (Optuna), the controller inside each trial; winners are checked on FEM.

The two verbs are `codesign.study.run_study` and `codesign.report.page.write_report`.
"""
