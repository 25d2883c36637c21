"""Measurements that cannot be right: what is wrong with them and what to do."""
