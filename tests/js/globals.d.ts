/** What the page's scripts find in the global scope: boot.js puts it there, plotly's script, or main.js for tests. */

declare var boot: { canShowVideo: boolean; early: any[]; shown: string[] | null; worker: Worker };
declare var Plotly: { react(...of: any[]): void; restyle(...of: any[]): void };
declare var tod: any;
