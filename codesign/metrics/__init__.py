"""Metrics of bodies, by what they are computed from; `METRICS` in `softgym_envs.codesign.metrics.metric` lists them."""
