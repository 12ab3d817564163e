// Colours of the plots.

export const axisColour = () => (matchMedia("(prefers-color-scheme: dark)").matches ? "#9aa4b0" : "#5a6470");
export const gridColour = () => (matchMedia("(prefers-color-scheme: dark)").matches ? "#343a42" : "#e3e6ea");
