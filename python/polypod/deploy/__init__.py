"""What an exported policy needs on a robot: the loops that obey its contract, and the check of a file.

- `onboard/`: the loops in Python and in C++. They need no polypod; `polypod deploy write` copies them.
- `header`: a contract as a C++ header.
- `check`: a file played through the Python loop in polypod and in MuJoCo.
"""
