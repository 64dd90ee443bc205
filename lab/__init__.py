"""The laboratory: programs that measure and document polypod.

They run in a checkout and are not in the wheel.
"""
