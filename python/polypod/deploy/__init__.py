"""What an exported policy needs on a robot: its contract, the loops that obey it, and the check of a file.

- `contract`: the contract that `polypod export` writes into each graph of one robot, as JSON.
- `onboard/`: the loops in Python and in C++. They need no polypod; `polypod deploy write` copies them.
- `header`: a contract as a C++ header.
- `check`: a file played through the Python loop in polypod and in MuJoCo.
"""
