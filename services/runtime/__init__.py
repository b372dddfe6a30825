"""What every process needs: logs, signals, traces, certificates, problems."""
