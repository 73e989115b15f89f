"""What an identification from fields assumed: known values, where borders lie, the law; and what it would find without the last."""
