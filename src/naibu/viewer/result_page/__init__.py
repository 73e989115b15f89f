"""Result page of an identification or a prediction."""
