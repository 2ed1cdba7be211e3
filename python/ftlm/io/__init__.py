"""Reading of measured data from text, spreadsheet, array and frequency-response files."""
