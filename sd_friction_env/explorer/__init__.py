"""The live explorer in the browser."""
