"""Samples of a task scored beside baselines, and tables of the results."""
