"""Gymnasium environments: the task, the single environment, the compiled batch and adapters to libraries."""
