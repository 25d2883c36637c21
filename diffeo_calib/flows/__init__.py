"""Flows of kernel vector fields: landmark geodesics, their integration, and what rides along."""
