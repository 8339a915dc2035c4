"""What trains and judges controllers: training, tuning, evaluation, optimal control, export, the report."""
