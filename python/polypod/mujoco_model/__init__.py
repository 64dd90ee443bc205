"""MuJoCo's model of a robot, from the description that polypod simulates.

`sim2sim`, `robustness`, `accuracy` and `bench` run it. It needs MuJoCo, of the `bench` extra.
"""
