"""The loops that run on a robot, in Python and in C++.

They need no polypod; the folder is copied as it is.
"""
