"""The suite on several cores: who runs what and when, what is made once for all workers, and what tests cost."""
