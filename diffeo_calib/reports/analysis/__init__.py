"""The numbers that reports and plots show, from a model alone or together with measurements."""
