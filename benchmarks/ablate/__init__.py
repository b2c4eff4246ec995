"""Ablation of the freeze: any rule or term by itself off, named combinations, one table. See `__main__.py`."""
