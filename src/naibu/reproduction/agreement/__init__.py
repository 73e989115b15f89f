"""What the report says of every chapter beside what was computed: agreement, differences and their reasons."""
