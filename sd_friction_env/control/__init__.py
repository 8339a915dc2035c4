"""Controllers in NumPy: classical feedback, trained networks, the agents of the package; videos of episodes."""
