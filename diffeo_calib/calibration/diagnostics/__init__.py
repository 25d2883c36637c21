"""Implausible measurements: refused or warned about, with the likely mistake and the remedy."""
