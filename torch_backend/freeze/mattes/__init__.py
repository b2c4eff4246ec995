"""Mattes of a take: one lasso at one frame becomes a matte at every pose, and a Cryptomatte of all of them."""
