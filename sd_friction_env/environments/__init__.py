"""The oscillator as Gymnasium environments: the task, one environment, the native batch, their adapters."""
