"""Run and frequency-response data: sampling, units, validation and file export."""
