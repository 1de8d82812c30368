"""From runs to numbers and verdicts: statistics, claims, the report, the results page."""
