"""Turns folders of runs and ground truth into figures: metrics, tables, plots, one page. Folders are only read."""
