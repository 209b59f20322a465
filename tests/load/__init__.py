"""How the workflow bears what happens to it: kills, hostile files, many frames, a cluster. Each writes rows into
results/load/, of which `table` makes workflow/docs/load.md; `make load` runs them all."""
