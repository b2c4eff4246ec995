"""Turns folders of runs and ground truth into figures: metrics, tables, plots and one page. Only reads these
folders."""
