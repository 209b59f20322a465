"""Sets with known hidden effects: Gaussian light, real beams, real frames with an effect put into their readings.
Effects and chain are those of `second`, with a shape of the light.

beams      the light: real beams, drawn ones, the Gaussian
case       grid, camera and light of a seed
moments    mean and variance of readings in closed form; `bound`: how well a design tells a change of them
strength   an effect at a multiple of its bound; `outside`: mechanisms that the vocabulary lacks
hene       what is put into the readings of real frames; `whole`: sets that are judged as they are
draw       one job, one dataset folder, one truth
plan       which sets are made, in which order
generator  the generator; `reading`, `score`, `page`: from its records to the score table
"""
