"""Deployment of an exported policy on a robot: loops that obey its contract, and check of a file.

- `onboard/`: the loops in Python and in C++. They need no polypod; `polypod deploy write` copies
  them.
- `header`: a contract as a C++ header.
- `check`: a file played through the Python loop in polypod and in MuJoCo.
"""
