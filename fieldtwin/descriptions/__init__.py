"""Device descriptions of other tools: conversion from and to device profiles, with a list of what is lost."""
