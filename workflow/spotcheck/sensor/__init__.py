"""The distribution of one reading: what a pixel reads [DN] under a light [DN of signal without black level].

In: a `SensorModel`, and functions of effects at the sensor's stages. Out: probabilities, moments, Fisher information
and random readings, exactly (`ReadingDistribution`) or as a table for millions of pixels (`ReadingTable`).
"""

from spotcheck.sensor.distribution import ReadingDistribution, Transfer
from spotcheck.sensor.model import ROUNDING_VARIANCE, SensorModel
from spotcheck.sensor.table import ReadingMoments, ReadingTable

__all__ = ["ROUNDING_VARIANCE", "ReadingDistribution", "ReadingMoments", "ReadingTable", "SensorModel", "Transfer"]
