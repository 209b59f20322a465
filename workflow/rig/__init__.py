"""The virtual rig: raw camera frames of a laser spot on carbon fibres, from first principles.

It shares no code with the analysis library, so that the analysis cannot find again what it put in itself.
"""
