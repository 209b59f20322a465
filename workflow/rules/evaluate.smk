# The simulated frames pass the very stages that the measured ones do.
use rule ingest as ingest_simulated with:
    input:
        rules.simulate.output.contract,
        frames=rules.simulate.output.frames,
    output:
        f"{OUT}/simulated/frames.nc",
    log:
        f"{OUT}/logs/ingest_simulated.log",
    benchmark:
        f"{OUT}/benchmarks/ingest_simulated.tsv"
    params:
        folder=simulated_folder,
        code=code("ingest"),
    message:
        "Recording every simulated frame of {wildcards.dataset}"


use rule crop as crop_simulated with:
    input:
        rules.simulate.output.contract,
        table=rules.ingest_simulated.output,
    output:
        f"{OUT}/simulated/crops.nc",
    log:
        f"{OUT}/logs/crop_simulated.log",
    benchmark:
        f"{OUT}/benchmarks/crop_simulated.tsv"
    params:
        folder=simulated_folder,
        code=code("crop"),
    message:
        "Cropping every simulated spot of {wildcards.dataset}"


use rule fit as fit_simulated with:
    input:
        manifest,
        instrument,
        crops=rules.crop_simulated.output,
        sensor=rules.sensor.output,
        # Frames are simulated of a sensor whose pixels are alike.
        maps=[],
    output:
        f"{OUT}/simulated/fits.nc",
    log:
        f"{OUT}/logs/fit_simulated.log",
    benchmark:
        f"{OUT}/benchmarks/fit_simulated.tsv"
    message:
        "Fitting every simulated crop of {wildcards.dataset}"
