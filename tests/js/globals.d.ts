/** Globals of the page's scripts, set by boot.js, by plotly's script, or by main.js for tests. */

declare var boot: { canShowVideo: boolean; early: any[]; shown: string[] | null; worker: Worker };
declare var Plotly: { react(...of: any[]): void; restyle(...of: any[]): void };
declare var tod: any;

// Of the audio thread, which the library for pages lacks.
declare class AudioWorkletProcessor {
  readonly port: MessagePort;
}
declare var currentTime: number;
declare function registerProcessor(name: string, processor: new () => AudioWorkletProcessor): void;
