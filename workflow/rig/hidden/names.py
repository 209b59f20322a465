"""Names: the contract's vocabulary, what lies outside it, strengths, and which effects are not hidden together."""

EFFECTS = (
    "saturation",
    "nonlinearity",
    "black_clipping",
    "dark_offset",
    "background_gradient",
    "super_gaussian",
    "scatter_halo",
    "fibre_anisotropy",
    "beam_ellipticity",
    "angle_reflectance",
    "photon_budget",
    "shutter_offset",
    "spread_law",
    "motion_blur",
    "interference_fringes",
    "ghost_reflection",
    "speckle",
    "excess_read_noise",
    "power_fluctuation",
    "laser_drift",
    "pointing_jitter",
    "fixed_pattern",
    "row_noise",
    "smear",
)

LEVELS = ("faint", "mid", "strong")

# Ties of the contract, and pairs that the simplest-wins rule would merge.
EXCLUSIVE = (
    {"spread_law", "shutter_offset"},
    {"fibre_anisotropy", "beam_ellipticity"},
    {"dark_offset", "background_gradient"},
    {"dark_offset", "black_clipping"},
    {"background_gradient", "black_clipping"},
)
EXCLUSIVE_AT_ONE_EXPOSURE = ({"motion_blur", "beam_ellipticity"}, {"motion_blur", "fibre_anisotropy"})
EXCLUSIVE_AT_ONE_SITE = (
    {"fixed_pattern", "speckle"},
    {"power_fluctuation", "laser_drift"},
    {"power_fluctuation", "photon_budget"},
    {"laser_drift", "photon_budget"},
)
