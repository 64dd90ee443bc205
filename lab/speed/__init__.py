"""The speed figures of docs/performance.md that `polypod bench` does not measure."""
