"""The figures of the paper and of the pages: python scripts/figures --help."""
