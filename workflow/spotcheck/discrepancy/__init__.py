"""Where simulation and measurement disagree, and what is missing: detect, locate, name, extend, verify, advise."""
