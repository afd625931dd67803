"""Results of a study: records, tables, plots, the HTML report and exported files."""
