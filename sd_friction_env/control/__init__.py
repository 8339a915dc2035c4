"""Policies in NumPy: classical controllers, trained networks, the agents that come with the package."""
