"""Thresholds that decide what a verdict reports.

The comment above each constant starts with its unit in brackets, says what the constant decides, and gives the reason
if there is one. `python -m tests.write_thresholds` writes these comments into the table of workflow/docs/verdict.md.
A "drop" is a drop of −2 ln L.
"""

# Detection

# [1] p-value of detection below which model and measurement disagree: one false alarm in 100 datasets. `alpha` in
# config.yaml sets it.
ALPHA = 0.01
# [peak of the spot] Rms of the mean image that may remain unexplained: half a code of an 8-bit camera that is used up
# to full scale. `of_peak` in config.yaml sets it.
TOLERANCE = 0.002
# [standard errors] Limit beyond which a difference is reported: what remains over the tolerance, a value against the
# data sheet, p1 and p2 under both models, and the power of a learned light shape that lies elsewhere than declared.
CLEAR_ERRORS = 3.0
# [gap] Largest gap on held-out frames, in parts of its expectation, of a model without effects that agrees with the
# frames; and largest gap of a held-out frame, in parts of the largest one of the searched frames, without a remark.
# Sums over 8 × 8 px then deviate by 3 times their noise. Sound frames stay below 1.5.
LARGEST_GAP = 10.0

# Effects

# [−2 ln L] Least drop, and least z², of an effect; also the least drop of χ² of a law. 25 corresponds to 5 standard
# errors: with about 100 starting points, noise alone produces a maximum of about 4.
MIN_GAIN = 25.0
# [standard errors] Least z of a law, a scatter, or a static shape that explains a free one: the root of `MIN_GAIN`.
MIN_Z = 5.0
# [−2 ln L] Least drop of an effect beside the free shape of a single site, where structure of the light cannot be
# distinguished from noise.
MIN_GAIN_AT_ONE_SITE = 100.0
# [−2 ln L] Drop that each further parameter must bring when candidates are compared. A superfluous parameter brings 1
# on average.
PARAMETER_PRICE = 6.0
# [−2 ln L] Difference within which two variants of an effect are tied, so that the first in the effect's list is named,
# and within which two effects are rivals. It corresponds to a likelihood ratio of about 150.
VARIANT_TIE = 10.0
# [χ²] Difference from the best set of laws within which other sets are its rivals. It corresponds to a likelihood ratio
# of about 150.
LAW_TIE = 10.0
# [1] Least variance of a fluctuation of spots, relative to the variance that granular light causes. The latter is
# estimated from few grains, so that it may be twice as large.
FIELD_MULTIPLE = 1.0
# [standard deviations] Excess of Cochran's Q over its degrees of freedom that the consistency test allows.
CELL_SLACK = 8.0
# [drop of the effect] The same as a fraction of the drop, for effects whose formula is nearly right; the larger of both
# counts. True effects stay below 0.017, false ones lie above 0.07.
CELL_MISFIT = 0.02
# [effects] Most effects of the mean image that one search adds.
MOST_EFFECTS = 5

# Light shape

# [peak of the spot] Rms of a free light shape below which the declared shape is kept.
SHAPE_FLOOR = 0.002
# [drop of a free shape] Share that the first, the second and each further effect must take if the declared shape is
# kept. A static shape must take at least `EXPLAINED_SHARE`.
SHAPE_SHARES = (0.4, 0.6, 0.8)
# [drop of a free shape] Share that named static shapes must take together to replace a free shape in the verdict.
EXPLAINED_SHARE = 0.9
# [drop of a free shape] Share that one, two and three static shapes must take for the search for this replacement to
# continue.
EXPLAINED_STEPS = (0.3, 0.6, 0.9)

# Upper limits and places

# [1] Probability that the strength of an effect lies within its limits.
CONFIDENCE = 0.95
# [standard errors] z of an effect that is not named above which part of it may be present, so that more frames would
# not lower its limit.
PRESENT_Z = 4.0
# [1] Misfit, not noise, sets a limit if it increases the error of the strength by more than this factor. More frames
# would not lower the limit.
MISFIT_INFLATION = 2.0
# [places] Most places that `where` lists for spot frames.
MOST_PLACES = 5
# [1] Family-wise p-value below which `where` lists a place.
PLACE_ALPHA = 0.01
