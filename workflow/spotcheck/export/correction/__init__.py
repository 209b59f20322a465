"""Corrected frames: electrons of the light in place of readings, with their variance."""
