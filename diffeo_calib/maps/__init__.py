"""The maps k0 and k1: nominal kinematics, their deformations and linearisations. No robot here."""
