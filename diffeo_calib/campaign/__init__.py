"""Campaigns that watch themselves: every row is judged as it comes, before it is taken in."""
