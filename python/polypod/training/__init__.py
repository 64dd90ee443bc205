"""Training with rsl_rl: configuration, run directories, the runner and its reports.

Needs the `train` extra.
"""
