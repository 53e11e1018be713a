"""Which observations tell most: criteria of designs and the choice by them, pure functions of arrays."""
