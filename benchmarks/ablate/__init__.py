"""Ablation of the freeze: each rule or term switched off alone or in named combinations. See `__main__.py`."""
