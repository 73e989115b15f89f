"""What speaks against an identification: data that do not belong together, outliers, contradicted heights; its verdict."""
