# The simulated frames pass the very stages that the measured ones do.
use rule ingest as ingest_simulated with:
    message:
        "Recording every simulated frame of {DATASET.name}"
    input:
        rules.simulate.output.contract,
        frames=rules.simulate.output.frames,
    output:
        f"{OUT}/simulated/frames.nc",
    params:
        folder=f"{OUT}/simulated",
        code=code("ingest"),
    log:
        f"{OUT}/logs/ingest_simulated.log",
    benchmark:
        f"{OUT}/benchmarks/ingest_simulated.tsv"


use rule crop as crop_simulated with:
    message:
        "Cropping every simulated spot of {DATASET.name}"
    input:
        rules.simulate.output.contract,
        rules.simulate.output.frames,
        table=rules.ingest_simulated.output,
    output:
        f"{OUT}/simulated/crops.nc",
    params:
        folder=f"{OUT}/simulated",
        code=code("crop"),
    log:
        f"{OUT}/logs/crop_simulated.log",
    benchmark:
        f"{OUT}/benchmarks/crop_simulated.tsv"


use rule fit as fit_simulated with:
    message:
        "Fitting every simulated crop of {DATASET.name}"
    input:
        crops=rules.crop_simulated.output,
        sensor=rules.sensor.output,
    output:
        f"{OUT}/simulated/fits.nc",
    log:
        f"{OUT}/logs/fit_simulated.log",
    benchmark:
        f"{OUT}/benchmarks/fit_simulated.tsv"
