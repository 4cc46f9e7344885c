"""Camera poses that nobody measured: estimated from masks, kept in a table, drawn on a sheet."""
