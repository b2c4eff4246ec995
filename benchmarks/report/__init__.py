"""Folders of runs and ground truth into figures: metrics, tables, plots, one page. Reads folders only."""
