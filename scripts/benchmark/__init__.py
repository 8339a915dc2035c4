"""The benchmark: what is timed, by subject, and the program (`python scripts/benchmark`)."""
