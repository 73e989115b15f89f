"""What an experiment that is planned will tell of moduli."""
