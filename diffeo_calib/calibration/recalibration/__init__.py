"""A calibrated robot measured again: what has changed since, and a model that knows the old rows and the new ones."""
