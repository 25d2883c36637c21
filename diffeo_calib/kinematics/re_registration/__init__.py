"""A model after the measuring device, a marker or the tool has moved: found anew from a few rows."""
