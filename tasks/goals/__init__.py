"""Goal sets: sampling, audits and the goals of splits."""
