"""The commands of `polypod`, one file each: its arguments, and what it does with them.

torch, TensorBoard and rsl_rl take seconds to import: each command imports what it needs when it
runs.
"""
