"""Thresholds that decide what a verdict names. "Drop" is a drop of −2 ln L."""

# Least drop for a name: 5 standard errors.
MIN_GAIN = 25.0
# Least z of laws and of scatter.
MIN_Z = 5.0
# Subtracted from a drop for each fitted parameter when candidates are compared.
PARAMETER_PRICE = 6.0
# Variants of one effect within this drop are tied, and the first in the effect's list is named.
VARIANT_TIE = 10.0
# Consistency: Cochran's Q may exceed its degrees of freedom by so many standard deviations, or by this part of the
# drop. True effects stay below 0.017 of it, false ones lie above 0.07.
CELL_SLACK, CELL_MISFIT = 8.0, 0.02
# Most effects of the mean image in one search.
MOST_EFFECTS = 5
# Sets of laws within this χ² of the best are its rivals.
LAW_TIE = 10.0
# Least drop of −2 ln L beside the free shape of a single site, where nothing tells structure of the light from noise.
MIN_GAIN_AT_ONE_SITE = 100.0
# Rms of a free shape [peak] below which the declared one is kept.
SHAPE_FLOOR = 0.002
# Part of what a free shape takes that the 1st, 2nd, 3rd effect beside the declared shape must take.
SHAPE_SHARES = (0.4, 0.6, 0.8)
# Part of what a free shape takes that named static shapes must take to stand for it, and that one, two, three of them
# must take for the search to go on.
EXPLAINED_SHARE = 0.9
EXPLAINED_STEPS = (0.3, 0.6, 0.9)
# p-value of detection below which model and measurement disagree: one false alarm in a hundred datasets.
ALPHA = 0.01
# Variance of spots that is named a fluctuation, over that which granular light brings: this is known from few grains,
# so that as much again may be its part.
FIELD_MULTIPLE = 1.0
# Rms of the mean image that may stay unexplained [peak]: half a code of an 8-bit camera used to its full scale.
TOLERANCE = 0.002
# Standard errors beyond which a change counts: of the data sheet, of what is left over the tolerance, of p1 and p2, and
# of the power of a learned light shape.
CLEAR_ERRORS = 3.0
# Confidence of upper limits.
CONFIDENCE = 0.95
# z from which on a strength that is not named is more than noise, and inflation of its errors by misfit from which on
# misfit sets its limit: more frames would not lower the limit then.
PRESENT_Z, MISFIT_INFLATION = 4.0, 2.0
# Most places that are reported, and the family-wise p-value below which a place is.
MOST_PLACES, PLACE_ALPHA = 5, 0.01
