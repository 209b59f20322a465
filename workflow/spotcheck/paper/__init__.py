"""The paper's numbers: each one's counterpart from the results of the default dataset, and the verdict."""
