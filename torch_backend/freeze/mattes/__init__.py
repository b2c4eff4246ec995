"""Mattes of a take: turns a lasso at one frame into a matte at every pose, and writes a Cryptomatte of all mattes."""
