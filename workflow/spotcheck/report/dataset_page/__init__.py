"""The report of a dataset: report.html, one self-contained page.

`report.write_report` reads a results folder. It writes the summary of the verdict, the frames beside their models, the
evidence, curves and tables. The scripts frames.js and plots.js (of `pages`) run in the browser.
"""
