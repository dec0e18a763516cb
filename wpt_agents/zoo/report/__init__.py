"""Run folders -> tables for a terminal, and one page that answers: did it work, how sure are we?"""
