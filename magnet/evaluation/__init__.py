"""Samples of a task scored beside baselines, and the tables that come of it."""
